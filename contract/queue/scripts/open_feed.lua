#!lua
-- OPEN_FEED: add a feed, unless it is known or too many are open.
-- ARGV   2 id, 3 tenant, 4 record as JSON, 5 time of its creation, 6 most feeds, 7 most of the tenant
-- Keys   feed:<id>, feeds, feeds:<tenant>, left:<id>
-- Answer {'there', the feed's hash}, or {'full', open feeds, those of the tenant}.

local id, own = ARGV[2], P .. 'feeds:' .. ARGV[3]
if redis.call('EXISTS', feed_key(id)) == 0 then
  local all, of_tenant = redis.call('ZCARD', P .. 'feeds'), redis.call('ZCARD', own)
  if all >= tonumber(ARGV[6]) or of_tenant >= tonumber(ARGV[7]) then return {'full', all, of_tenant} end
  redis.call('DEL', P .. 'left:' .. id)
  redis.call('HSET', feed_key(id), 'document', ARGV[4], 'tenant', ARGV[3], 'wish', 'run', 'epoch', '0')
  redis.call('ZADD', P .. 'feeds', ARGV[5], id)
  redis.call('ZADD', own, ARGV[5], id)
end
return {'there', redis.call('HGETALL', feed_key(id))}
