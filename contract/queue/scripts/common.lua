-- What all scripts share; the loader puts it between a script's first line and the rest of it.
-- KEYS 1: the prefix of all keys, which names the cluster's slot.
-- ARGV 1: the numbers of contract/queue/interface.py and the table of transitions, as JSON. Each script names the others.

local P, RULES = KEYS[1], cjson.decode(ARGV[1])
local PRIORITIES = {'high', 'standard'}
-- A job's hash says which worker holds its entry. All workers are one consumer, so that none is left behind.
local GROUP, CONSUMER = 'workers', 'worker'
-- A released entry counts as idle for longer than any lease, so that anybody may claim it at once.
local LONG_MS = 86400000
-- How many unfinished deliveries each tenant has; the events are in tenant:<tenant>:owed, by when they are due.
local OWED = P .. 'owed-by'

local function now()
  local clock = redis.call('TIME')
  return clock[1] .. '.' .. string.format('%06d', clock[2])
end

-- The time so many ms from now.
local function later(ms) return string.format('%.6f', tonumber(now()) + tonumber(ms) / 1000) end

local function stream(priority) return P .. 'jobs:' .. priority end
local function waiting(priority) return P .. 'waiting:' .. priority end
local function waiting_of(tenant) return P .. 'tenant:' .. tenant .. ':waiting' end
local function document(id) return P .. 'job:' .. id end
local function owed_of(tenant) return P .. 'tenant:' .. tenant .. ':owed' end
-- Stands while a service tries.
local function trying(event) return P .. 'trying:' .. event end
local function deliveries(id) return P .. 'deliveries:' .. id end
-- The job of an event, and the event of a job's last end (contract/wire/webhooks.py: event_id).
local function job_of(event) return string.match(event, '^[^.]*') end
local function event_of(job) return job.id .. '.' .. job.attempt .. '.' .. job.state end

local function table_of(flat)
  local found = {}
  for i = 1, #flat, 2 do found[flat[i]] = flat[i + 1] end
  return found
end

-- A job's hash and its id; nil if there is none, or if its fields are not those of a job.
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

-- Writes every change of a job, and an event with what it left. A field whose value is false is removed.
local function write(job, changes)
  for name, value in pairs(changes) do
    job[name] = value or nil
    if value then redis.call('HSET', document(job.id), name, value) else redis.call('HDEL', document(job.id), name) end
  end
  local event = {}
  for _, name in ipairs(RULES.event_fields) do
    if job[name] then event[#event + 1] = name; event[#event + 1] = job[name] end
  end
  redis.call('XADD', P .. 'events:' .. job.id, 'MAXLEN', RULES.max_events, '*', unpack(event))
end

local function drop(priority, entry)
  redis.call('XACK', stream(priority), GROUP, entry)
  redis.call('XDEL', stream(priority), entry)
end

-- The indexes repeat what the hashes say: call `leave` before a change of state and `enter` after it.
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

-- When a delivery is due; nil: it is finished.
local function set_due(tenant, event, at)
  local own = owed_of(tenant)
  if at then redis.call('ZADD', own, at, event) else redis.call('ZREM', own, event) end
  local count = redis.call('ZCARD', own)
  if count > 0 then redis.call('HSET', OWED, tenant, count) else redis.call('HDEL', OWED, tenant) end
end

-- A job has ended: if it has a callback, the delivery is due at once.
local function add_delivery(job)
  if not job.callback then return end
  local is_json, fault = pcall(cjson.decode, job.error or '')
  local delivery = {event_id = event_of(job), state = job.state, ended_at_s = job.finished}
  if is_json and type(fault) == 'table' then delivery.error_code = fault.code end
  if redis.call('HSETNX', deliveries(job.id), delivery.event_id, cjson.encode(delivery)) == 1 then
    set_due(job.tenant, delivery.event_id, now())
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
    add_delivery(job)
  end
end

-- The only place that changes a state; false if TRANSITIONS has no such change.
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
    change(job, 'queued', {progress = false, returned = '1'})
  end
end

-- Leave the job's entry pending, and let anybody claim it at once.
local function offer(job)
  redis.call('XCLAIM', stream(job.priority), GROUP, CONSUMER, 0, job.entry, 'IDLE', LONG_MS, 'JUSTID')
end

-- Renew the lease: the job's entry has been idle for 0 ms.
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

local function feed_key(id) return P .. 'feed:' .. id end

-- Who follows a feed; nil if nobody does, or the lease has expired.
local function feed_owner(id)
  local found = redis.call('HMGET', feed_key(id), 'owner', 'lease')
  return found[1] and found[2] and tonumber(found[2]) > tonumber(now()) and found[1] or nil
end

-- Whether a feed's last claim is this one. A late beat is accepted as long as nobody else has claimed the feed.
local function is_feed_of(id, owner, epoch)
  local found = redis.call('HMGET', feed_key(id), 'owner', 'epoch')
  return found[1] == owner and tonumber(found[2]) == tonumber(epoch)
end
