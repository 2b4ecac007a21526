"""A live feed: its newest stereo pair, its recording, a model that follows it, and its past.

`feed` joins them: `source` hands over the newest pair of a source that a confined process reads, and records it;
`model` gives pairs that show tissue to the follower of `follow`; `past` keeps what that knew; `looking` finds times.

Verbs: Feed.report, .moment, .wait_for_newer, .cut, .pause, .resume, .close; followed.follow for users.
"""
