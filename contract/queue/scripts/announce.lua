#!lua flags=allow-oom
-- ANNOUNCE: say that a worker is live, and drop the names of those that have fallen silent.
-- ARGV   2 name, 3 address as JSON, 4 its life in ms
-- Keys   worker:<name>, workers
-- Answer 1.

redis.call('SET', P .. 'worker:' .. ARGV[2], ARGV[3], 'PX', ARGV[4])
redis.call('SADD', P .. 'workers', ARGV[2])
for _, name in ipairs(redis.call('SMEMBERS', P .. 'workers')) do
  if redis.call('EXISTS', P .. 'worker:' .. name) == 0 then redis.call('SREM', P .. 'workers', name) end
end
return 1
