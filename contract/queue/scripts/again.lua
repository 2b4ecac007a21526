#!lua
-- AGAIN: make the delivery about a job's last end due now, whatever became of it; not while a service tries.
-- ARGV   2 event, 3 the delivery as JSON as the caller has read it, '' if there is none, 4 the same, owed anew
-- Keys   job:<id>, trying:<event>, deliveries:<id>, owed-by, tenant:<tenant>:owed
-- Answer nothing.

local event, kept, job = ARGV[2], deliveries(job_of(ARGV[2])), read(job_of(ARGV[2]))
if not (job and job.callback) or event ~= event_of(job) or redis.call('EXISTS', trying(event)) == 1 then return end
local found = redis.call('HGET', kept, event) or ''
if found ~= ARGV[3] and found ~= ARGV[4] then return end  -- it was tried since
redis.call('HSET', kept, event, ARGV[4])
set_due(job.tenant, event, now())
