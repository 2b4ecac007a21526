#!lua flags=allow-oom
-- CLAIM_FEED: give a worker the oldest feed that nobody follows.
-- ARGV   2 owner, 3 lease in ms, 4 '1': of those alone that are to end
-- Keys   feeds, feed:<id>
-- Answer {id, the feed's hash}; {}: there is none.

local name = string.match(ARGV[2], '^(.*)%.') or ARGV[2]
for _, id in ipairs(redis.call('ZRANGE', P .. 'feeds', 0, -1)) do
  local owner = feed_owner(id)
  local is_free = not owner or (owner ~= ARGV[2] and (string.match(owner, '^(.*)%.') or owner) == name)
  if is_free and (ARGV[4] ~= '1' or redis.call('HGET', feed_key(id), 'wish') == 'end') then
    redis.call('HINCRBY', feed_key(id), 'epoch', 1)
    redis.call('HSET', feed_key(id), 'owner', ARGV[2], 'lease', later(ARGV[3]))
    return {id, redis.call('HGETALL', feed_key(id))}
  end
end
return {}
