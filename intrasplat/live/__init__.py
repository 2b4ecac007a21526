"""A live feed. `source` hands over the newest stereo pair of a source that a confined process reads, and records it.

Verbs: open_source; then Source.newest, .pause, .resume, .cut, .close.
"""
