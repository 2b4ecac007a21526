"""The scripts by which the queue on Redis changes; contract/queue_redis.py says what the keys are and runs them.

Each is atomic, uses the server's clock, and gives the same answer when it is run again because its answer was lost.
COMMON is put before each by script_text(), which also fills in the numbers between @ signs. ARGV[1] is the table of
transitions, so that no second copy of it exists here.
"""

from __future__ import annotations

from contract.queue import EVENTS_KEPT, LEASE_S, MAX_ATTEMPTS, PREEMPT_AFTER_S

LONG_IDLE_MS = 10 * round(LEASE_S * 1000)
"""As if nobody had beaten for so long: an entry that waits to be claimed again."""


def script_text(body: str, *, when_full: bool) -> str:
    """A whole script; when_full: it runs even when the server's memory is full, because it ends something."""
    numbers = {
        "FLAGS": "allow-oom" if when_full else "",
        "EVENTS": EVENTS_KEPT,
        "LEASE_MS": round(LEASE_S * 1000),
        "LONG_IDLE": LONG_IDLE_MS,
        "MAX_ATTEMPTS": MAX_ATTEMPTS,
        "PREEMPT_MS": round(PREEMPT_AFTER_S * 1000),
    }
    text = COMMON + body
    for name, value in numbers.items():
        text = text.replace(f"@{name}@", str(value))
    return text


COMMON = """#!lua flags=@FLAGS@
local P = '{intrasplat}:'
local GROUP = 'workers'
local clock = redis.call('TIME')
local now = tonumber(clock[1]) * 1000 + math.floor(tonumber(clock[2]) / 1000)
local now_s = clock[1] .. '.' .. string.format('%06d', clock[2])
local TRANSITIONS = cjson.decode(ARGV[1])

local function key(id) return P .. 'job:' .. id end
local function field(id, name) return redis.call('HGET', key(id), name) end
local function stream(priority) return P .. 'jobs:' .. priority end
local function among(list, value)
  for _, each in ipairs(list) do if each == value then return true end end
  return false
end

-- Every change of a job ends here: listeners read what it left.
local function note(id)
  local state = redis.call('HMGET', key(id), 'state', 'attempt', 'released', 'owner', 'cancel', 'progress', 'error',
    'started', 'finished')
  local names = {'state', 'attempt', 'released', 'owner', 'cancel', 'progress', 'error', 'started', 'finished'}
  local entry = {}
  for n, name in ipairs(names) do
    if state[n] then entry[#entry + 1] = name; entry[#entry + 1] = state[n] end
  end
  redis.call('XADD', P .. 'events:' .. id, 'MAXLEN', @EVENTS@, '*', unpack(entry))
end

local function drop_entry(id)
  local held = redis.call('HMGET', key(id), 'entry', 'priority')
  if held[1] then
    redis.call('XACK', stream(held[2]), GROUP, held[1])
    redis.call('XDEL', stream(held[2]), held[1])
  end
end

local function stop_waiting(id)
  redis.call('ZREM', P .. 'waiting', id)
  redis.call('ZREM', P .. 'waiting:' .. field(id, 'tenant'), id)
end

-- again: handed back, so before those of its priority that were never claimed. Scores: rank, then order of arrival.
local function start_waiting(id, again)
  local rank = (field(id, 'priority') == 'high' and 0 or 2) + (again and 0 or 1)
  local place = rank * 1e12 + redis.call('INCR', P .. 'arrivals')
  redis.call('ZADD', P .. 'waiting', place, id)
  redis.call('ZADD', P .. 'waiting:' .. field(id, 'tenant'), place, id)
  redis.call('HSET', key(id), 'since', now)
end

-- false if the table has no such change.
local function change(id, target)
  local state = field(id, 'state')
  if not among(TRANSITIONS[state] or {}, target) then return false end
  if state == 'queued' then stop_waiting(id) end
  if state == 'running' then
    redis.call('SREM', P .. 'running', id)
    redis.call('HDEL', P .. 'held', field(id, 'owner'))
  end
  if state == 'failed' then redis.call('ZREM', P .. 'dead', id) end
  redis.call('HSET', key(id), 'state', target)
  if target == 'running' then redis.call('SADD', P .. 'running', id) end
  if target == 'done' or target == 'failed' or target == 'cancelled' then
    redis.call('HSET', key(id), 'finished', now_s)
    redis.call('HINCRBY', P .. 'ended', target, 1)
    drop_entry(id)
  end
  if target == 'failed' then redis.call('ZADD', P .. 'dead', now, id) end
  return true
end

-- The entry stays in the group's list of pending ones, as if nobody had beaten for long: the next claim finds it.
local function queue_again(id)
  change(id, 'queued')
  redis.call('HDEL', key(id), 'progress')
  start_waiting(id, true)
  local held = redis.call('HMGET', key(id), 'entry', 'priority')
  redis.call('XCLAIM', stream(held[2]), GROUP, 'nobody', 0, held[1], 'IDLE', @LONG_IDLE@, 'FORCE', 'JUSTID')
  redis.call('XADD', P .. 'bell', 'MAXLEN', 1, '*', 'job', id)
  note(id)
end

-- After the death of its worker.
local function bury_or_queue(id, error)
  local record = redis.call('HMGET', key(id), 'attempt', 'released', 'cancel')
  if record[3] then
    change(id, 'cancelled')
    note(id)
  elseif tonumber(record[1]) - tonumber(record[2]) >= @MAX_ATTEMPTS@ then
    redis.call('HSET', key(id), 'error', error)
    change(id, 'failed')
    note(id)
  else
    queue_again(id)
  end
end

-- Whether the job runs as this attempt of this owner.
local function holds(id, owner, attempt)
  local record = redis.call('HMGET', key(id), 'state', 'owner', 'attempt')
  return record[1] == 'running' and record[2] == owner and record[3] == attempt
end

-- Whether this very claim brought the job to `target` before, and the answer was lost.
local function settled(id, owner, attempt, target)
  local record = redis.call('HMGET', key(id), 'state', 'owner', 'attempt')
  return record[1] == target and record[2] == owner and record[3] == attempt
end

local function add_entry(id)
  local entry = redis.call('XADD', stream(field(id, 'priority')), '*', 'job', id)
  redis.call('HSET', key(id), 'entry', entry)
end
"""

SUBMIT = """
-- ARGV 2 id, 3 document, 4 tenant, 5 priority, 6 idempotency key or '', 7 its life in ms, 8 created,
--      9 most waiting or '', 10 most of the tenant
-- Answers {'ok', id that stands} or {'all' | 'tenant', how many wait}.
local id, tenant, once = ARGV[2], ARGV[4], P .. 'once:' .. ARGV[4] .. ':' .. ARGV[6]
if redis.call('EXISTS', key(id)) == 1 then return {'ok', id} end
if ARGV[6] ~= '' then
  local first = redis.call('GET', once)
  if first and redis.call('EXISTS', key(first)) == 1 then return {'ok', first} end
end
if ARGV[9] ~= '' then
  local own, all = redis.call('ZCARD', P .. 'waiting:' .. tenant), redis.call('ZCARD', P .. 'waiting')
  if own >= tonumber(ARGV[10]) then return {'tenant', own} end
  if all >= tonumber(ARGV[9]) then return {'all', all} end
end
if ARGV[6] ~= '' then redis.call('SET', once, id, 'PX', ARGV[7]) end
redis.call('HSET', key(id), 'document', ARGV[3], 'state', 'queued', 'attempt', 0, 'released', 0, 'tenant', tenant,
  'priority', ARGV[5], 'once', ARGV[6])
redis.call('ZADD', P .. 'index', ARGV[8], id)
redis.call('ZADD', P .. 'index:' .. tenant, ARGV[8], id)
add_entry(id)
start_waiting(id, false)
note(id)
return {'ok', id}
"""

RESTORE = """
-- ARGV 2 id, 3 document, 4 tenant, 5 priority, 6 created, 7 state, 8 attempt, 9 finished
local id = ARGV[2]
if redis.call('EXISTS', key(id)) == 1 then return 0 end
redis.call('HSET', key(id), 'document', ARGV[3], 'state', ARGV[7], 'attempt', ARGV[8], 'released', 0,
  'tenant', ARGV[4], 'priority', ARGV[5], 'once', '', 'started', ARGV[9], 'finished', ARGV[9])
redis.call('ZADD', P .. 'index', ARGV[6], id)
redis.call('ZADD', P .. 'index:' .. ARGV[4], ARGV[6], id)
note(id)
return 1
"""

CLAIM = """
-- ARGV 2 owner, 3 the error of a job whose workers died
-- Answers {id of the job that is now the owner's or '', last id of high, of standard, of the bell}.
local owner = ARGV[2]

local function take(id)
  change(id, 'running')
  redis.call('HSET', key(id), 'owner', owner, 'attempt', tonumber(field(id, 'attempt')) + 1, 'started', now_s)
  redis.call('HDEL', key(id), 'progress')
  redis.call('HSET', P .. 'held', owner, id)
  note(id)
  return {id}
end

-- An entry is of use if it is the one its job names: others are left from before a retry or a purge.
local function useful(priority, entry, fields)
  local id = fields and fields[2]
  if id and field(id, 'entry') == entry and (field(id, 'state') == 'queued' or field(id, 'state') == 'running') then
    return id
  end
  redis.call('XACK', stream(priority), GROUP, entry)
  redis.call('XDEL', stream(priority), entry)
  return nil
end

local mine = redis.call('HGET', P .. 'held', owner)
if mine then return {mine} end

for _, priority in ipairs({'high', 'standard'}) do
  if redis.call('EXISTS', stream(priority)) == 0
    or #redis.call('XINFO', 'GROUPS', stream(priority)) == 0 then
    redis.call('XGROUP', 'CREATE', stream(priority), GROUP, '0', 'MKSTREAM')
  end
end

for _, priority in ipairs({'high', 'standard'}) do
  local cursor = '0-0'
  repeat
    local found = redis.call('XAUTOCLAIM', stream(priority), GROUP, owner, @LEASE_MS@, cursor, 'COUNT', 10)
    cursor = found[1]
    -- What XAUTOCLAIM has touched is this owner's until it is put back, so all of it is looked at.
    local waiting = {}
    for _, entry in ipairs(found[2]) do
      local id = useful(priority, entry[1], entry[2])
      if id and field(id, 'state') == 'running' then bury_or_queue(id, ARGV[3]) end
      if id and field(id, 'state') == 'queued' then waiting[#waiting + 1] = {id, entry[1]} end
    end
    local first = table.remove(waiting, 1)
    for _, other in ipairs(waiting) do
      redis.call('XCLAIM', stream(priority), GROUP, 'nobody', 0, other[2], 'IDLE', @LONG_IDLE@, 'JUSTID')
    end
    if first then
      redis.call('XCLAIM', stream(priority), GROUP, owner, 0, first[2], 'IDLE', 0, 'JUSTID')
      return take(first[1])
    end
  until cursor == '0-0'
  while true do
    local found = redis.call('XREADGROUP', 'GROUP', GROUP, owner, 'COUNT', 1, 'STREAMS', stream(priority), '>')
    if not found or #found == 0 then break end
    local entry = found[1][2][1]
    local id = useful(priority, entry[1], entry[2])
    if id then return take(id) end
  end
end

local function last(name)
  if redis.call('EXISTS', name) == 0 then return '0-0' end
  local info = redis.call('XINFO', 'STREAM', name)
  for n = 1, #info, 2 do if info[n] == 'last-generated-id' then return info[n + 1] end end
  return '0-0'
end
return {'', last(stream('high')), last(stream('standard')), last(P .. 'bell')}
"""

BEAT = """
-- ARGV 2 id, 3 owner, 4 attempt, 5 progress or ''
-- Answers an Order.
local id, owner = ARGV[2], ARGV[3]
if not holds(id, owner, ARGV[4]) then return 'lost' end
local record = redis.call('HMGET', key(id), 'entry', 'priority', 'cancel')
redis.call('XCLAIM', stream(record[2]), GROUP, owner, 0, record[1], 'IDLE', 0, 'FORCE', 'JUSTID')
if ARGV[5] ~= '' then
  redis.call('HSET', key(id), 'progress', ARGV[5])
  note(id)
end
if record[3] then return 'cancel' end
if record[2] == 'high' then return 'go-on' end
-- Scores below 2e12 are of high priority (start_waiting).
for _, other in ipairs(redis.call('ZRANGEBYSCORE', P .. 'waiting', '0', '(2000000000000')) do
  if now - tonumber(field(other, 'since')) >= @PREEMPT_MS@
    and redis.call('SET', P .. 'yields:' .. other, owner, 'NX', 'PX', @LEASE_MS@) then
    return 'yield'
  end
end
return 'go-on'
"""

SETTLE = """
-- ARGV 2 id, 3 owner, 4 attempt, 5 target, 6 error or '', 7 durations kept
-- A job whose cancellation was asked for ends as cancelled, and no other does.
local id, target = ARGV[2], ARGV[5]
if settled(id, ARGV[3], ARGV[4], target) then return 1 end
if not holds(id, ARGV[3], ARGV[4]) then return 0 end
if (target == 'cancelled') ~= (field(id, 'cancel') == '1') then return 0 end
if ARGV[6] ~= '' then redis.call('HSET', key(id), 'error', ARGV[6]) end
if not change(id, target) then return 0 end
if target == 'done' then
  redis.call('LPUSH', P .. 'durations', tonumber(now_s) - tonumber(field(id, 'started')))
  redis.call('LTRIM', P .. 'durations', 0, tonumber(ARGV[7]) - 1)
end
note(id)
return 1
"""

RELEASE = """
-- ARGV 2 id, 3 owner, 4 attempt, 5 '1' if the worker died, 6 the error of a job whose workers died
local id = ARGV[2]
if settled(id, ARGV[3], ARGV[4], 'queued') then return 1 end
if not holds(id, ARGV[3], ARGV[4]) or field(id, 'cancel') then return 0 end
if ARGV[5] == '1' then
  bury_or_queue(id, ARGV[6])
else
  redis.call('HINCRBY', key(id), 'released', 1)
  queue_again(id)
end
return 1
"""

CANCEL = """
-- ARGV 2 id
local id = ARGV[2]
local state = field(id, 'state')
if (state == 'queued' or state == 'running') and not field(id, 'cancel') then
  redis.call('HSET', key(id), 'cancel', '1')
  if state == 'queued' then change(id, 'cancelled') end
  note(id)
end
return 1
"""

RETRY = """
-- ARGV 2 id
local id = ARGV[2]
if field(id, 'state') ~= 'failed' or not change(id, 'queued') then return 0 end
redis.call('HSET', key(id), 'released', field(id, 'attempt'))
redis.call('HDEL', key(id), 'error', 'finished', 'progress')
add_entry(id)
start_waiting(id, false)
note(id)
return 1
"""

FORGET = """
-- ARGV 2 id, 3 terminal states, JSON
local id = ARGV[2]
local record = redis.call('HMGET', key(id), 'state', 'tenant', 'once')
if not record[1] or not among(cjson.decode(ARGV[3]), record[1]) then return 0 end
local once = P .. 'once:' .. record[2] .. ':' .. record[3]
if record[3] ~= '' and redis.call('GET', once) == id then redis.call('DEL', once) end
redis.call('ZREM', P .. 'index', id)
redis.call('ZREM', P .. 'index:' .. record[2], id)
redis.call('ZREM', P .. 'dead', id)
redis.call('DEL', key(id), P .. 'events:' .. id, P .. 'yields:' .. id)
return 1
"""
