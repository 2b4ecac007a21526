#!lua flags=allow-oom
-- SETTLE: bring a running job to its end. A job whose cancellation was asked for ends as cancelled, and no other does.
-- ARGV   2 id, 3 owner, 4 attempt, 5 target state, 6 error or ''
-- Keys   job:<id>, held, ended, jobs:<priority>, dead, durations, events:<id>
-- Answer 1: this claim has brought the job to that end; 0: the claim does not hold, or a cancel is in the way.

local job, target = read(ARGV[2]), ARGV[5]
if not is_of(job, ARGV[3], ARGV[4]) then return 0 end
if job.state == target then return 1 end
if job.state ~= 'running' or (target == 'cancelled') ~= (job.cancel ~= nil) then return 0 end
if not change(job, target, {error = ARGV[6] ~= '' and ARGV[6]}) then return 0 end
if target == 'done' then
  redis.call('LPUSH', P .. 'durations', tonumber(job.finished) - tonumber(job.started))
  redis.call('LTRIM', P .. 'durations', 0, RULES.max_durations - 1)
end
return 1
