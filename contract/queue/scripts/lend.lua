#!lua flags=allow-oom
-- LEND: lend a service the delivery that has been due for longest. Its score in `owed` is when the loan runs out.
-- ARGV   2 token of the call, 3 how long the loan lasts in ms
-- Keys   owed, lent:<token>, deliveries:<id>, job:<id>
-- Answer {delivery as JSON, callback, tenant, score}; {}: none is due.

local lent = P .. 'lent:' .. ARGV[2]
local function answer(event)
  local id = job_of(event)
  local delivery = redis.call('HGET', deliveries(id), event)
  local job = redis.call('HMGET', document(id), 'callback', 'tenant')
  if delivery and job[1] and job[2] then return {delivery, job[1], job[2], redis.call('ZSCORE', OWED, event)} end
end

local mine = redis.call('GET', lent)
if mine and redis.call('ZSCORE', OWED, mine) then return answer(mine) or {} end
for _, event in ipairs(redis.call('ZRANGE', OWED, '-inf', now(), 'BYSCORE', 'LIMIT', 0, 100)) do
  redis.call('ZADD', OWED, later(ARGV[3]), event)
  local found = answer(event)
  if found then
    redis.call('SET', lent, event, 'PX', ARGV[3])
    return found
  end
  redis.call('ZREM', OWED, event)
end
return {}
