#!lua flags=allow-oom
-- LEAVE_FEED: a worker follows a feed no longer; if it has ended the feed, its record is removed.
-- ARGV   2 id, 3 owner, 4 epoch, 5 '1': it has ended the feed
-- Keys   feed:<id>, feeds, feeds:<tenant>, left:<id>
-- Answer 1; 0: the claim is no longer valid, or the feed is not to end.

local id, left = ARGV[2], P .. 'left:' .. ARGV[2]
local token = ARGV[3] .. ' ' .. ARGV[4] .. ' ' .. ARGV[5]
if redis.call('GET', left) == token then return 1 end
if not is_feed_of(id, ARGV[3], ARGV[4]) then return 0 end
if ARGV[5] == '1' then
  local found = redis.call('HMGET', feed_key(id), 'wish', 'tenant')
  if found[1] ~= 'end' then return 0 end
  redis.call('DEL', feed_key(id))
  redis.call('ZREM', P .. 'feeds', id)
  redis.call('ZREM', P .. 'feeds:' .. found[2], id)
else
  redis.call('HDEL', feed_key(id), 'owner', 'lease')
end
redis.call('SET', left, token, 'PX', 60000)
return 1
