#!lua flags=allow-oom
-- NOTE: keep what became of a delivery that was lent.
-- ARGV   2 event, 3 its score when it was lent, 4 the delivery as JSON, '' to keep it as it is, 5 its status,
--        6 ms until it is due again, '' if it is owed no more, 7 tenant
-- Keys   owed-by, tenant:<tenant>:owed, trying:<event>, deliveries:<id>, delivered
-- Answer 1: it is kept; 0: the loan does not hold, or the job is gone.

local event, tenant, kept = ARGV[2], ARGV[7], deliveries(job_of(ARGV[2]))
if redis.call('HGET', kept, event) == ARGV[4] then return 1 end
if redis.call('ZSCORE', owed_of(tenant), event) ~= ARGV[3] then return 0 end
if ARGV[4] ~= '' then redis.call('HSET', kept, event, ARGV[4]) end
redis.call('DEL', trying(event))
set_due(tenant, event, ARGV[6] ~= '' and later(ARGV[6]) or nil)
if ARGV[6] == '' then redis.call('HINCRBY', P .. 'delivered', ARGV[5], 1) end
return 1
