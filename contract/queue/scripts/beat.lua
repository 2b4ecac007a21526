#!lua flags=allow-oom
-- BEAT: renew the lease of a claim (common.lua: renew), write progress, and say what the worker is to do.
-- ARGV   2 id, 3 owner, 4 attempt, 5 progress or ''
-- Keys   job:<id>, jobs:<priority>, waiting:high, queued, yield:<id>, events:<id>
-- Answer an Order: go-on, cancel, yield or lost.

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
    -- One worker makes way for each waiting job, and hears so until it has.
    if redis.call('SET', asked, job.owner, 'NX', 'PX', RULES.yield_ms) or redis.call('GET', asked) == job.owner then
      return 'yield'
    end
  end
end
return 'go-on'
