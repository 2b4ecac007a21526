#!lua flags=allow-oom
-- WISH_FEED: change what the caller wants of a feed. An end is never taken back.
-- ARGV   2 id, 3 wish
-- Keys   feed:<id>
-- Answer the feed's hash; {}: there is none.

local known = redis.call('HGET', feed_key(ARGV[2]), 'wish')
if known and known ~= 'end' then redis.call('HSET', feed_key(ARGV[2]), 'wish', ARGV[3]) end
return redis.call('HGETALL', feed_key(ARGV[2]))
