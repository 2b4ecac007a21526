"""The scripts that change the queue on Redis; contract/queue/redis_queue.py says what the keys hold, and runs them.

Each is atomic, goes by the server's clock, and when it is run again because its answer was lost, answers as before
and changes nothing more. All are given KEYS[1], the prefix of all keys (it names the cluster's slot), and ARGV[1], the
numbers and the table of transitions of the contract, as JSON; the others are said with each.
"""

from __future__ import annotations

COMMON = """
local P, RULES = KEYS[1], cjson.decode(ARGV[1])
local PRIORITIES = {'high', 'standard'}
-- Who holds an entry is said by its job; one name of a consumer serves all, so that none is left behind by a worker.
local GROUP, CONSUMER = 'workers', 'worker'
-- What is given back has been idle for longer than any lease.
local LONG_MS = 86400000

local function now()
  local clock = redis.call('TIME')
  return clock[1] .. '.' .. string.format('%06d', clock[2])
end

local function stream(priority) return P .. 'jobs:' .. priority end
local function waiting(priority) return P .. 'waiting:' .. priority end
local function waiting_of(tenant) return P .. 'tenant:' .. tenant .. ':waiting' end
local function document(id) return P .. 'job:' .. id end

local function table_of(flat)
  local found = {}
  for i = 1, #flat, 2 do found[flat[i]] = flat[i + 1] end
  return found
end

-- A job's hash, and its id; nil if there is none, or none that a script could work with.
local function read(id)
  local flat = redis.pcall('HGETALL', document(id))
  if flat.err then return nil end
  local job = table_of(flat)
  if not (job.state and job.tenant and job.entry and (job.priority == 'high' or job.priority == 'standard')) then
    return nil
  end
  job.id, job.attempt, job.released = id, tonumber(job.attempt) or 0, tonumber(job.released) or 0
  return job
end

-- Every change of a job is written here, and is an event. A field that is false goes.
local function write(job, changes)
  for name, value in pairs(changes) do
    job[name] = value or nil
    if value then redis.call('HSET', document(job.id), name, value) else redis.call('HDEL', document(job.id), name) end
  end
  local event = {}
  for _, name in ipairs(RULES.event_fields) do
    if job[name] then event[#event + 1] = name; event[#event + 1] = job[name] end
  end
  redis.call('XADD', P .. 'events:' .. job.id, 'MAXLEN', RULES.events_kept, '*', unpack(event))
end

local function drop(priority, entry)
  redis.call('XACK', stream(priority), GROUP, entry)
  redis.call('XDEL', stream(priority), entry)
end

-- The indexes say again what the hashes say: `leave` before a change of state, `enter` after it.
local function leave(job)
  if job.state == 'queued' then
    redis.call('ZREM', waiting(job.priority), job.id)
    redis.call('ZREM', P .. 'queued', job.id)
    redis.call('SREM', waiting_of(job.tenant), job.id)
  elseif job.state == 'running' then
    redis.call('HDEL', P .. 'held', job.owner)
  elseif job.state == 'failed' then
    redis.call('ZREM', P .. 'dead', job.id)
  end
end

local function enter(job)
  if job.state == 'queued' then
    redis.call('ZADD', waiting(job.priority), job.sequence, job.id)
    redis.call('ZADD', P .. 'queued', job.queued, job.id)
    redis.call('SADD', waiting_of(job.tenant), job.id)
  elseif job.state == 'running' then
    redis.call('HSET', P .. 'held', job.owner, job.id)
    redis.call('DEL', P .. 'yield:' .. job.id)
  else
    redis.call('HINCRBY', P .. 'ended', job.state, 1)
    drop(job.priority, job.entry)
    if job.state == 'failed' then redis.call('ZADD', P .. 'dead', job.finished, job.id) end
  end
end

-- The one place where a state changes; false if TRANSITIONS has no such change.
local function change(job, target, changes)
  if not RULES.sources[target][job.state] then return false end
  leave(job)
  changes.state = target
  if target == 'queued' then changes.queued = now() end
  if target == 'done' or target == 'failed' or target == 'cancelled' then changes.finished = now() end
  write(job, changes)
  enter(job)
  return true
end

-- The last place in the line of its priority.
local function last_place(id, priority)
  return redis.call('INCR', P .. 'sequence'), redis.call('XADD', stream(priority), '*', 'job', id)
end

-- The worker that ran the job is dead: it is queued again, or given up.
local function count_death(job)
  if job.cancel then
    change(job, 'cancelled', {})
  elseif job.attempt - job.released >= RULES.max_attempts then
    change(job, 'failed', {error = RULES.worker_died})
  else
    change(job, 'queued', {progress = false})
  end
end

-- Its entry stays with the group, and is anybody's at once.
local function offer(job)
  redis.call('XCLAIM', stream(job.priority), GROUP, CONSUMER, 0, job.entry, 'IDLE', LONG_MS, 'JUSTID')
end

local function renew(job)
  redis.call('XCLAIM', stream(job.priority), GROUP, CONSUMER, 0, job.entry, 'IDLE', 0, 'JUSTID')
end

-- Whether the job's last claim is this one.
local function is_of(job, owner, attempt) return job and job.owner == owner and job.attempt == tonumber(attempt) end

local function index(id, tenant, created)
  redis.call('ZADD', P .. 'index', created, id)
  redis.call('ZADD', P .. 'tenant:' .. tenant .. ':index', created, id)
end

local function idempotency(tenant, hash) return P .. 'idempotency:' .. tenant .. ':' .. hash end
"""

SUBMIT = """
-- ARGV 2 id, 3 fields of its hash as JSON, 4 created, 5 idempotency hash or '', 6 its life in ms,
--      7 how many may wait or '', 8 and of one tenant
-- {'stands', id, hash}: what the queue holds now. {'full', waiting, of the tenant}: nothing was changed.
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
"""

RESTORE = """
-- ARGV 2 id, 3 fields of its hash as JSON, 4 created, 5 idempotency hash or '', 6 the rest of its life in ms, 7 token
-- 1: restored, by this call. Not counted as ended: it ended long ago.
local id, changes = ARGV[2], cjson.decode(ARGV[3])
if redis.call('EXISTS', document(id)) == 1 then
  return redis.call('HGET', document(id), 'restored') == ARGV[7] and 1 or 0
end
if ARGV[5] ~= '' and tonumber(ARGV[6]) > 0 then
  redis.call('SET', idempotency(changes.tenant, ARGV[5]), id, 'NX', 'PX', ARGV[6])
end
changes.restored, changes.entry = ARGV[7], '0-0'
write({id = id}, changes)
if changes.state == 'failed' then redis.call('ZADD', P .. 'dead', changes.finished or 0, id) end
index(id, changes.tenant, ARGV[4])
return 1
"""

CLAIM = """
-- ARGV 2 owner
-- {1, id, hash}: the owner's now. {0, last id of jobs:high, of jobs:standard, how many entries are pending}: none.
local owner = ARGV[2]

local function answer(job)
  renew(job)
  return {1, job.id, redis.call('HGETALL', document(job.id))}
end

local function group_of(priority)
  local groups = redis.pcall('XINFO', 'GROUPS', stream(priority))
  for _, flat in ipairs(groups) do
    local group = table_of(flat)
    if group.name == GROUP then return group end
  end
  redis.call('XGROUP', 'CREATE', stream(priority), GROUP, '0', 'MKSTREAM')
end

-- A job that no script can work with fails, as far as there is a hash, and is in nobody's way.
local function set_aside(id, priority)
  redis.pcall('HSET', document(id), 'state', 'failed', 'error', RULES.unreadable, 'finished', now())
  redis.call('ZREM', waiting(priority), id)
  redis.call('ZREM', P .. 'queued', id)
  local tenant = redis.pcall('HGET', document(id), 'tenant')
  if type(tenant) == 'string' then redis.call('SREM', waiting_of(tenant), id) end
  redis.call('HINCRBY', P .. 'ended', 'failed', 1)
  redis.call('ZADD', P .. 'dead', now(), id)
end

-- The job of a stream's entry, now the owner's; nil if the entry was of no use, and is gone.
local function take(priority, entry, fields)
  local id = table_of(fields).job
  local job = id and read(id)
  local known = job and RULES.sources[job.state]
  if known and job.entry == entry then
    if job.state == 'running' then count_death(job) end
    local claim = {owner = owner, attempt = job.attempt + 1, started = now(), progress = false}
    if change(job, 'running', claim) then return answer(job) end
  elseif id and not known and redis.call('EXISTS', document(id)) == 1 then
    set_aside(id, priority)
  end
  drop(priority, entry)
  return nil
end

-- An entry that was given back, or whose lease has run out.
local function take_pending(priority)
  local cursor = '0-0'
  repeat
    local found = redis.call(
      'XAUTOCLAIM', stream(priority), GROUP, CONSUMER, RULES.lease_ms, cursor, 'COUNT', 1)
    cursor = found[1]
    for _, entry in ipairs(found[2]) do
      local taken = take(priority, entry[1], entry[2])
      if taken then return taken end
    end
  until cursor == '0-0'
end

local function take_new(priority)
  while true do
    local found = redis.call('XREADGROUP', 'GROUP', GROUP, CONSUMER, 'COUNT', 1, 'STREAMS', stream(priority), '>')
    if not found or #found == 0 then return nil end
    local entry = found[1][2][1]
    local taken = take(priority, entry[1], entry[2])
    if taken then return taken end
  end
end

for _, priority in ipairs(PRIORITIES) do group_of(priority) end
-- Held already: the answer to the last claim was lost.
local held = redis.call('HGET', P .. 'held', owner)
local mine = held and read(held)
if mine and mine.state == 'running' and mine.owner == owner then return answer(mine) end
for _, priority in ipairs(PRIORITIES) do
  local taken = take_pending(priority) or take_new(priority)
  if taken then return taken end
end
local high, standard = group_of('high'), group_of('standard')
return {0, high['last-delivered-id'], standard['last-delivered-id'], high.pending + standard.pending}
"""

BEAT = """
-- ARGV 2 id, 3 owner, 4 attempt, 5 progress or ''. Answers an Order.
local job = read(ARGV[2])
if not is_of(job, ARGV[3], ARGV[4]) or job.state ~= 'running' then return 'lost' end
renew(job)
if ARGV[5] ~= '' and ARGV[5] ~= job.progress then write(job, {progress = ARGV[5]}) end
if job.cancel then return 'cancel' end
if job.priority == 'high' then return 'go-on' end
for _, id in ipairs(redis.call('ZRANGE', waiting('high'), 0, -1)) do
  local since = redis.call('ZSCORE', P .. 'queued', id)
  if since and tonumber(now()) - tonumber(since) >= RULES.preempt_ms / 1000 then
    local asked = P .. 'yield:' .. id
    -- One worker makes way for each; the one that does is told so until it has.
    if redis.call('SET', asked, job.owner, 'NX', 'PX', RULES.yield_ms) or redis.call('GET', asked) == job.owner then
      return 'yield'
    end
  end
end
return 'go-on'
"""

SETTLE = """
-- ARGV 2 id, 3 owner, 4 attempt, 5 target, 6 error or ''. 1: the job has come to its end by this claim.
-- A job whose cancellation was asked for ends as cancelled, and no other does.
local job, target = read(ARGV[2]), ARGV[5]
if not is_of(job, ARGV[3], ARGV[4]) then return 0 end
if job.state == target then return 1 end
if job.state ~= 'running' or (target == 'cancelled') ~= (job.cancel ~= nil) then return 0 end
if not change(job, target, {error = ARGV[6] ~= '' and ARGV[6]}) then return 0 end
if target == 'done' then
  redis.call('LPUSH', P .. 'durations', tonumber(job.finished) - tonumber(job.started))
  redis.call('LTRIM', P .. 'durations', 0, RULES.durations_kept - 1)
end
return 1
"""

RELEASE = """
-- ARGV 2 id, 3 owner, 4 attempt, 5 '1' if the worker died. 1: the job is queued again, or given up.
local job, died = read(ARGV[2]), ARGV[5] == '1'
if not is_of(job, ARGV[3], ARGV[4]) then return 0 end
if job.state == 'queued' or (died and job.state == 'failed' and job.error == RULES.worker_died) then return 1 end
if job.state ~= 'running' or job.cancel then return 0 end
if died then
  count_death(job)
elseif not change(job, 'queued', {progress = false, released = job.released + 1}) then
  return 0
end
if job.state == 'queued' then offer(job) end
return 1
"""

CANCEL = """
-- ARGV 2 id. The hash afterwards.
local job = read(ARGV[2])
if job and not job.cancel then
  if job.state == 'queued' then
    change(job, 'cancelled', {cancel = '1'})
  elseif job.state == 'running' then
    write(job, {cancel = '1'})
  end
end
return redis.call('HGETALL', document(ARGV[2]))
"""

RETRY = """
-- ARGV 2 id, 3 attempt after which to try again: not after a later one. The hash afterwards.
local job = read(ARGV[2])
if job and job.state == 'failed' and job.attempt == tonumber(ARGV[3]) then
  local fresh = {released = job.attempt, error = false, progress = false, started = false, finished = false}
  fresh.sequence, fresh.entry = last_place(job.id, job.priority)
  change(job, 'queued', fresh)
end
return redis.call('HGETALL', document(ARGV[2]))
"""

FORGET = """
-- ARGV 2 id, 3 terminal states as JSON, 4 idempotency hash or '', 5 token. 1: removed, by this call.
local id, gone = ARGV[2], P .. 'forgotten:' .. ARGV[2]
local state = redis.call('HGET', document(id), 'state')
if not state then return redis.call('GET', gone) == ARGV[5] and 1 or 0 end
if not cjson.decode(ARGV[3])[state] then return 0 end
local tenant = redis.call('HGET', document(id), 'tenant') or ''
local once = idempotency(tenant, ARGV[4])
if redis.call('GET', once) == id then redis.call('DEL', once) end
redis.call('DEL', document(id), P .. 'events:' .. id)
redis.call('ZREM', P .. 'index', id)
redis.call('ZREM', P .. 'tenant:' .. tenant .. ':index', id)
redis.call('ZREM', P .. 'dead', id)
redis.call('SET', gone, ARGV[5], 'PX', 60000)
return 1
"""

ANNOUNCE = """
-- ARGV 2 name, 3 address as JSON, 4 its life in ms
redis.call('SET', P .. 'worker:' .. ARGV[2], ARGV[3], 'PX', ARGV[4])
redis.call('SADD', P .. 'workers', ARGV[2])
for _, name in ipairs(redis.call('SMEMBERS', P .. 'workers')) do
  if redis.call('EXISTS', P .. 'worker:' .. name) == 0 then redis.call('SREM', P .. 'workers', name) end
end
return 1
"""


def script_text(body: str, *, when_full: bool) -> str:
    """The whole script. when_full: it may run when the server's memory is full, because it brings work to its end."""
    return f"#!lua{' flags=allow-oom' if when_full else ''}\n{COMMON}{body}"
