#!lua flags=allow-oom
-- CLAIM: give a worker the next job and a lease on it. The lease is the idle time of the job's stream entry: claiming
-- and beating (beat.lua) set it to 0 (common.lua: renew). Any worker may claim an entry that was idle for lease_ms.
-- ARGV   2 owner
-- Keys   held, jobs:high|standard, job:<id>, the indexes of its state, yield:<id>, ended, events:<id>, served,
--        owed-by, tenant:<tenant>:owed, deliveries:<id>
-- Answer {1, id, hash}: the owner's now. {0, last id of jobs:high, of jobs:standard, how many entries are pending}: none.

local owner = ARGV[2]
-- When each tenant was given a job, and for how long that is remembered.
local SERVED, SERVED_S = P .. 'served', 86400

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
  local ended = {id = id, state = 'failed', error = RULES.unreadable, finished = now()}
  redis.pcall('HSET', document(id), 'state', ended.state, 'error', ended.error, 'finished', ended.finished)
  redis.call('ZREM', waiting(priority), id)
  redis.call('ZREM', P .. 'queued', id)
  redis.call('HINCRBY', P .. 'ended', ended.state, 1)
  redis.call('ZADD', P .. 'dead', ended.finished, id)
  local flat = redis.pcall('HGETALL', document(id))
  if flat.err then return end -- no hash: whose job it was is not known
  local left = table_of(flat)
  ended.tenant, ended.callback, ended.attempt = left.tenant, left.callback, tonumber(left.attempt) or 0
  if not ended.tenant then return end
  redis.call('SREM', waiting_of(ended.tenant), id)
  add_delivery(ended)
end

-- Give the owner the job of a stream's entry; nil if the entry had no job to give. Then it is removed.
local function take(priority, entry, fields)
  local id = table_of(fields).job
  local job = id and read(id)
  local known = job and RULES.sources[job.state]
  if known and job.entry == entry then
    if job.state == 'running' then count_death(job) end
    local claim = {owner = owner, attempt = job.attempt + 1, started = now(), progress = false, returned = false}
    if change(job, 'running', claim) then return answer(job) end
  elseif id and not known and redis.call('EXISTS', document(id)) == 1 then
    set_aside(id, priority)
  end
  drop(priority, entry)
  return nil
end

-- Make the entries that nobody has read pending, and anybody's at once: all that wait can then be chosen from.
local function deliver(priority)
  while true do
    local found = redis.call('XREADGROUP', 'GROUP', GROUP, CONSUMER, 'COUNT', 100, 'STREAMS', stream(priority), '>')
    if not found or #found == 0 then return end
    for _, entry in ipairs(found[1][2]) do offer({priority = priority, entry = entry[1]}) end
  end
end

-- A job that came back to the queue, or whose lease has run out. nil and the other waiting jobs, oldest first: none.
local function take_returned(priority)
  local fresh, from = {}, '-'
  while true do
    local found = redis.call('XPENDING', stream(priority), GROUP, 'IDLE', RULES.lease_ms, from, '+', 100)
    if #found == 0 then return nil, fresh end
    for _, pending in ipairs(found) do
      local entry = pending[1]
      local row = redis.call('XRANGE', stream(priority), entry, entry)[1]
      local fields = row and row[2] or {}
      local id = table_of(fields).job
      local job = id and read(id)
      if job and job.state == 'queued' and job.entry == entry and not job.returned then
        fresh[#fresh + 1] = job
      else
        local taken = take(priority, entry, fields)
        if taken then return taken end
      end
      from = '(' .. entry
    end
  end
end

-- The first job of the tenant that has the fewest running; among equals, of the one that was given a job longest ago.
-- contract/queue/interface.py: claim_order says the same.
local function take_fresh(priority, fresh)
  local running, heads = {}, {}
  for _, id in ipairs(redis.call('HVALS', P .. 'held')) do
    local job = read(id)
    if job then running[job.tenant] = (running[job.tenant] or 0) + 1 end
  end
  for _, job in ipairs(fresh) do
    if not heads[job.tenant] then
      heads[job.tenant], heads[#heads + 1] = true, job
      job.running, job.served = running[job.tenant] or 0, tonumber(redis.call('ZSCORE', SERVED, job.tenant) or 0)
    end
  end
  local best
  for _, job in ipairs(heads) do
    local is_before = not best or job.running < best.running or (job.running == best.running and job.served < best.served)
    if is_before then best = job end
  end
  if not best then return nil end
  redis.call('ZADD', SERVED, now(), best.tenant)
  redis.call('EXPIRE', SERVED, SERVED_S)
  return take(priority, best.entry, {'job', best.id})
end

for _, priority in ipairs(PRIORITIES) do group_of(priority) end
-- The owner holds a job already: the answer to its last claim was lost.
local held = redis.call('HGET', P .. 'held', owner)
local mine = held and read(held)
if mine and mine.state == 'running' and mine.owner == owner then return answer(mine) end
for _, priority in ipairs(PRIORITIES) do
  deliver(priority)
  local taken, fresh = take_returned(priority)
  taken = taken or take_fresh(priority, fresh)
  if taken then return taken end
end
local high, standard = group_of('high'), group_of('standard')
return {0, high['last-delivered-id'], standard['last-delivered-id'], high.pending + standard.pending}
