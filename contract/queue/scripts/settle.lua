#!lua flags=allow-oom
-- SETTLE: bring a running job to its end. A job whose cancellation was asked for ends as cancelled, and no other does.
-- ARGV   2 id, 3 owner, 4 attempt, 5 target state, 6 error or ''
-- Keys   job:<id>, held, ended, jobs:<priority>, dead, durations, rests, events:<id>, owed-by,
--        tenant:<tenant>:owed, deliveries:<id>
-- Answer 1: this claim has brought the job to that end; 0: the claim does not hold, or a cancel is in the way.

-- Whether a job takes in a scene that was made elsewhere: how long that takes says nothing of other jobs.
local function is_import(job)
  local is_json, record = pcall(cjson.decode, job.document or '')
  return is_json and type(record) == 'table' and type(record.imported) == 'table'
end

-- The seconds of training that a job's options ask for; nil if they name none.
-- contract/queue/interface.py: asked_training_s says the same.
local function asked_training_s(job)
  local is_json, record = pcall(cjson.decode, job.document or '')
  local options = is_json and type(record) == 'table' and record.options
  if type(options) ~= 'table' or type(options.iterations) == 'number' then return nil end
  return type(options.budget_s) == 'number' and options.budget_s or RULES.budgets_s[options.preset]
end

local job, target = read(ARGV[2]), ARGV[5]
if not is_of(job, ARGV[3], ARGV[4]) then return 0 end
if job.state == target then return 1 end
if job.state ~= 'running' or (target == 'cancelled') ~= (job.cancel ~= nil) then return 0 end
if not change(job, target, {error = ARGV[6] ~= '' and ARGV[6]}) then return 0 end
if target == 'done' and not is_import(job) then
  local took_s, asked_s = tonumber(job.finished) - tonumber(job.started), asked_training_s(job)
  redis.call('LPUSH', P .. 'durations', took_s)
  redis.call('LTRIM', P .. 'durations', 0, RULES.max_durations - 1)
  if asked_s then
    redis.call('LPUSH', P .. 'rests', took_s - asked_s)
    redis.call('LTRIM', P .. 'rests', 0, RULES.max_durations - 1)
  end
end
return 1
