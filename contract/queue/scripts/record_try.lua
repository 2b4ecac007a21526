#!lua flags=allow-oom
-- RECORD_TRY: store the result of trying a claimed delivery.
-- ARGV   2 event, 3 its score when it was claimed, 4 the delivery as JSON, '' to leave it as it is, 5 its status,
--        6 ms until it is due again, '' if it is finished, 7 tenant
-- Keys   owed-by, tenant:<tenant>:owed, trying:<event>, deliveries:<id>, delivered
-- Answer 1: it is stored; 0: the claim has expired, or the job is gone.

local event, tenant, stored = ARGV[2], ARGV[7], deliveries(job_of(ARGV[2]))
if redis.call('HGET', stored, event) == ARGV[4] then return 1 end
if redis.call('ZSCORE', owed_of(tenant), event) ~= ARGV[3] then return 0 end
if ARGV[4] ~= '' then redis.call('HSET', stored, event, ARGV[4]) end
redis.call('DEL', trying(event))
set_due(tenant, event, ARGV[6] ~= '' and later(ARGV[6]) or nil)
if ARGV[6] == '' then redis.call('HINCRBY', P .. 'delivered', ARGV[5], 1) end
return 1
