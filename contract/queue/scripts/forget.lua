#!lua flags=allow-oom
-- FORGET: remove the record, the events, the deliveries and the idempotency key of an ended job.
-- ARGV   2 id, 3 terminal states as JSON, 4 idempotency hash or '', 5 token
-- Keys   job:<id>, events:<id>, idempotency:<tenant>:<hash>, index, dead, owed-by, tenant:<tenant>:owed,
--        deliveries:<id>, trying:<event>, forgotten:<id>
-- Answer 1: this call has removed it; 0: there is none, or it has not ended.

local id, gone = ARGV[2], P .. 'forgotten:' .. ARGV[2]
local state = redis.call('HGET', document(id), 'state')
if not state then return redis.call('GET', gone) == ARGV[5] and 1 or 0 end
if not cjson.decode(ARGV[3])[state] then return 0 end
local tenant = redis.call('HGET', document(id), 'tenant') or ''
local once = idempotency(tenant, ARGV[4])
if redis.call('GET', once) == id then redis.call('DEL', once) end
for _, event in ipairs(redis.call('HKEYS', deliveries(id))) do
  set_due(tenant, event, nil)
  redis.call('DEL', trying(event))
end
redis.call('DEL', document(id), P .. 'events:' .. id, deliveries(id))
redis.call('ZREM', P .. 'index', id)
redis.call('ZREM', P .. 'tenant:' .. tenant .. ':index', id)
redis.call('ZREM', P .. 'dead', id)
redis.call('SET', gone, ARGV[5], 'PX', 60000)
return 1
