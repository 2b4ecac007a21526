#!lua
-- RELABEL: change a job's labels; nothing else, and in whatever state it is.
-- ARGV   2 id, 3 the fields that change as JSON, '' where there is nothing any more
-- Keys   job:<id>, events:<id>
-- Answer the job's hash afterwards.

local job, changes = read(ARGV[2]), {}
if job then
  for name, value in pairs(cjson.decode(ARGV[3])) do
    if value ~= (job[name] or '') then changes[name] = value ~= '' and value end
  end
  if next(changes) then write(job, changes) end
end
return redis.call('HGETALL', document(ARGV[2]))
