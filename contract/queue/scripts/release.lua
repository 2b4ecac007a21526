#!lua flags=allow-oom
-- RELEASE: queue a running job again, first in line; or give it up if its worker died once too often.
-- ARGV   2 id, 3 owner, 4 attempt, 5 '1' if the worker died
-- Keys   job:<id>, held, jobs:<priority>, the indexes of queued jobs, ended, dead, events:<id>, owed-by,
--        tenant:<tenant>:owed, deliveries:<id>
-- Answer 1: the job is queued again, or given up; 0: the claim does not hold, or a cancel is in the way.

local job, died = read(ARGV[2]), ARGV[5] == '1'
if not is_of(job, ARGV[3], ARGV[4]) then return 0 end
if job.state == 'queued' or (died and job.state == 'failed' and job.error == RULES.worker_died) then return 1 end
if job.state ~= 'running' or job.cancel then return 0 end
if died then
  count_death(job)
elseif not change(job, 'queued', {progress = false, returned = '1', released = job.released + 1}) then
  return 0
end
if job.state == 'queued' then offer(job) end
return 1
