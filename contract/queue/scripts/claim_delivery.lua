#!lua flags=allow-oom
-- CLAIM_DELIVERY: give a service the delivery that has been due for longest. Its score is then when the claim expires.
-- ARGV   2 token of the call, 3 how long the claim lasts in ms, 4 and more: tenants to skip
-- Keys   owed, owed-by, tenant:<tenant>:owed, lent:<token>, trying:<event>, deliveries:<id>, job:<id>
-- Answer {event, delivery as JSON, callback, tenant, score, trace or ''}; {}: none is due.

local claimed, skipped = P .. 'lent:' .. ARGV[2], {}
for i = 4, #ARGV do skipped[ARGV[i]] = true end

local function answer(event)
  local id = job_of(event)
  local delivery = redis.call('HGET', deliveries(id), event)
  local job = redis.pcall('HMGET', document(id), 'callback', 'tenant', 'trace')
  if not (delivery and job[1] and job[2]) then return nil end
  local score = redis.call('ZSCORE', owed_of(job[2]), event)
  return score and {event, delivery, job[1], job[2], score, job[3] or ''}
end

local function first_due()
  local tenant, event, at
  for _, each in ipairs(redis.call('HKEYS', OWED)) do
    local head = skipped[each] and {} or redis.call('ZRANGE', owed_of(each), 0, 0, 'WITHSCORES')
    if head[1] and (not at or tonumber(head[2]) < at) then tenant, event, at = each, head[1], tonumber(head[2]) end
  end
  if at and at <= tonumber(now()) then return tenant, event end
end

-- Earlier workers write what is owed into one set of all tenants.
for _, event in ipairs(redis.call('ZRANGE', P .. 'owed', 0, 99)) do
  local tenant = redis.pcall('HMGET', document(job_of(event)), 'tenant')[1]
  if tenant then set_due(tenant, event, redis.call('ZSCORE', P .. 'owed', event)) end
  redis.call('ZREM', P .. 'owed', event)
end

local mine = redis.call('GET', claimed)
local mine_still = mine and answer(mine)
if mine_still then return mine_still end
while true do
  local tenant, event = first_due()
  if not event then return {} end
  set_due(tenant, event, later(ARGV[3]))
  local found = answer(event)
  if found then
    redis.call('SET', claimed, event, 'PX', ARGV[3])
    redis.call('SET', trying(event), '1', 'PX', ARGV[3])
    return found
  end
  set_due(tenant, event, nil)
end
