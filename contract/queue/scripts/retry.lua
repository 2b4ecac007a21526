#!lua
-- RETRY: queue a failed job again, last in line, with its earlier deaths forgiven.
-- ARGV   2 id, 3 the attempt that failed: a job that has been retried since stays as it is
-- Keys   job:<id>, dead, sequence, jobs:<priority>, the indexes of queued jobs, events:<id>
-- Answer the job's hash afterwards.

local job = read(ARGV[2])
if job and job.state == 'failed' and job.attempt == tonumber(ARGV[3]) then
  local fresh = {released = job.attempt, error = false, progress = false, started = false, finished = false}
  fresh.sequence, fresh.entry = last_place(job.id, job.priority)
  change(job, 'queued', fresh)
end
return redis.call('HGETALL', document(ARGV[2]))
