#!lua flags=allow-oom
-- CANCEL: end a queued job; ask the worker of a running one to stop.
-- ARGV   2 id
-- Keys   job:<id>, the indexes of queued jobs, ended, jobs:<priority>, events:<id>, owed-by, tenant:<tenant>:owed,
--        deliveries:<id>
-- Answer the job's hash afterwards.

local job = read(ARGV[2])
if job and not job.cancel then
  if job.state == 'queued' then
    change(job, 'cancelled', {cancel = '1'})
  elseif job.state == 'running' then
    write(job, {cancel = '1'})
  end
end
return redis.call('HGETALL', document(ARGV[2]))
