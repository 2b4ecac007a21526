#!lua
-- SUBMIT: enqueue a job, unless it or the job of its idempotency key is known, or too many wait.
-- ARGV   2 id, 3 fields of its hash as JSON, 4 created, 5 idempotency hash or '', 6 its life in ms,
--        7 how many may wait or '', 8 and of one tenant
-- Keys   idempotency:<tenant>:<hash>, job:<id>, sequence, jobs:<priority>, the indexes of queued jobs, index, events:<id>
-- Answer {'stands', id, hash}: what the queue holds now. {'full', waiting, of the tenant}: nothing was changed.

local id, job = ARGV[2], cjson.decode(ARGV[3])
local once = idempotency(job.tenant, ARGV[5])
local earlier = ARGV[5] ~= '' and redis.call('GET', once)
for _, known in ipairs({id, earlier or nil}) do
  local hash = redis.call('HGETALL', document(known))
  if #hash > 0 then return {'stands', known, hash} end
end
if ARGV[7] ~= '' then
  local all, own = redis.call('ZCARD', P .. 'queued'), redis.call('SCARD', waiting_of(job.tenant))
  if all >= tonumber(ARGV[7]) or own >= tonumber(ARGV[8]) then return {'full', all, own} end
end
if ARGV[5] ~= '' then redis.call('SET', once, id, 'PX', ARGV[6]) end
local changes = job
job = {id = id}
changes.sequence, changes.entry = last_place(id, changes.priority)
changes.queued = now()
write(job, changes)
enter(job)
index(id, job.tenant, ARGV[4])
return {'stands', id, redis.call('HGETALL', document(id))}
