"""A live feed: its newest stereo pair, its recording, and a model that follows it.

`source` hands over the newest pair of a source that a confined process reads, and records it; `follow` learns pairs and
shows the newest moment and the past.

Verbs: open_source, then Source.newest, .pause, .resume, .cut, .close; Follower.add, .scene_at.
"""
