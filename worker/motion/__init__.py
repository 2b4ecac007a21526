"""Frames with depth in, tracks out: the motion of the tissue before training, and how many bases it needs.

Verbs: tracks.track, tracks.fit_tracks, capacity.
"""
