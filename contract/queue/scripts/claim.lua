#!lua flags=allow-oom
-- CLAIM: give a worker the next job and a lease on it. The lease is the idle time of the job's stream entry: claiming
-- and beating (beat.lua) set it to 0 (common.lua: renew). Any worker may claim an entry that was idle for lease_ms.
-- ARGV   2 owner
-- Keys   held, jobs:high|standard, job:<id>, the indexes of its state, yield:<id>, ended, events:<id>
-- Answer {1, id, hash}: the owner's now. {0, last id of jobs:high, of jobs:standard, how many entries are pending}: none.

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

-- Fail a job whose hash no script can work with, so that it does not block the queue.
local function set_aside(id, priority)
  redis.pcall('HSET', document(id), 'state', 'failed', 'error', RULES.unreadable, 'finished', now())
  redis.call('ZREM', waiting(priority), id)
  redis.call('ZREM', P .. 'queued', id)
  local tenant = redis.pcall('HGET', document(id), 'tenant')
  if type(tenant) == 'string' then redis.call('SREM', waiting_of(tenant), id) end
  redis.call('HINCRBY', P .. 'ended', 'failed', 1)
  redis.call('ZADD', P .. 'dead', now(), id)
end

-- Give the owner the job of a stream's entry; nil if the entry had no job to give. Then it is removed.
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

-- An entry that was released, or whose lease has run out.
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
-- The owner holds a job already: the answer to its last claim was lost.
local held = redis.call('HGET', P .. 'held', owner)
local mine = held and read(held)
if mine and mine.state == 'running' and mine.owner == owner then return answer(mine) end
for _, priority in ipairs(PRIORITIES) do
  local taken = take_pending(priority) or take_new(priority)
  if taken then return taken end
end
local high, standard = group_of('high'), group_of('standard')
return {0, high['last-delivered-id'], standard['last-delivered-id'], high.pending + standard.pending}
