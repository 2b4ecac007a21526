#!lua
-- RESTORE: put back the record of an ended job that the queue has lost. It does not count in `ended` again; whether its
-- webhook was delivered is lost, too, so it is owed, unless the job ended long ago.
-- ARGV   2 id, 3 fields of its hash as JSON, 4 created, 5 idempotency hash or '', 6 the rest of its life in ms, 7 token
-- Keys   job:<id>, idempotency:<tenant>:<hash>, dead, index, events:<id>, owed-by, tenant:<tenant>:owed,
--        deliveries:<id>
-- Answer 1: this call has restored it; 0: the queue knows the job.

local id, changes = ARGV[2], cjson.decode(ARGV[3])
if redis.call('EXISTS', document(id)) == 1 then
  return redis.call('HGET', document(id), 'restored') == ARGV[7] and 1 or 0
end
if ARGV[5] ~= '' and tonumber(ARGV[6]) > 0 then
  redis.call('SET', idempotency(changes.tenant, ARGV[5]), id, 'NX', 'PX', ARGV[6])
end
changes.restored, changes.entry = ARGV[7], '0-0'
local job = {id = id}
write(job, changes)
if tonumber(job.finished or 0) > now() - RULES.owed_for_s then add_delivery(job) end
if changes.state == 'failed' then redis.call('ZADD', P .. 'dead', changes.finished or 0, id) end
index(id, changes.tenant, ARGV[4])
return 1
