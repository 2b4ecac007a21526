#!lua flags=allow-oom
-- WISH_FEED: change what the caller wants of a feed. An end is never taken back; a feed that no worker ever claimed ends
-- at once.
-- ARGV   2 id, 3 wish
-- Keys   feed:<id>, feeds, feeds:<tenant>
-- Answer the feed's hash; {}: there is none.

local known = redis.call('HMGET', feed_key(ARGV[2]), 'wish', 'epoch', 'tenant')
if known[1] and ARGV[3] == 'end' and known[2] == '0' then
  redis.call('DEL', feed_key(ARGV[2]))
  redis.call('ZREM', P .. 'feeds', ARGV[2])
  redis.call('ZREM', P .. 'feeds:' .. known[3], ARGV[2])
elseif known[1] and known[1] ~= 'end' then
  redis.call('HSET', feed_key(ARGV[2]), 'wish', ARGV[3])
end
return redis.call('HGETALL', feed_key(ARGV[2]))
