#!lua flags=allow-oom
-- NOTE: keep what became of a delivery that was lent.
-- ARGV   2 event, 3 its score in `owed` when it was lent, 4 the delivery as JSON, 5 its status,
--        6 ms until it is due again, '' if it is owed no more
-- Keys   owed, deliveries:<id>, delivered
-- Answer 1: it is kept; 0: the loan does not hold, or the job is gone.

local event, kept = ARGV[2], deliveries(job_of(ARGV[2]))
if redis.call('HGET', kept, event) == ARGV[4] then return 1 end
if redis.call('ZSCORE', OWED, event) ~= ARGV[3] then return 0 end
redis.call('HSET', kept, event, ARGV[4])
if ARGV[6] ~= '' then
  redis.call('ZADD', OWED, later(ARGV[6]), event)
else
  redis.call('ZREM', OWED, event)
  redis.call('HINCRBY', P .. 'delivered', ARGV[5], 1)
end
return 1
