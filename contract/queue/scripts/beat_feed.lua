#!lua flags=allow-oom
-- BEAT_FEED: renew the lease of a feed and store its worker's report.
-- ARGV   2 id, 3 owner, 4 epoch, 5 report as JSON, 6 lease in ms
-- Keys   feed:<id>
-- Answer the wish; '': the claim is no longer valid.

if not is_feed_of(ARGV[2], ARGV[3], ARGV[4]) then return '' end
redis.call('HSET', feed_key(ARGV[2]), 'report', ARGV[5], 'reported', now(), 'lease', later(ARGV[6]))
return redis.call('HGET', feed_key(ARGV[2]), 'wish')
