"""Depth clip in; tracks of its tissue out, and the numbers of bases and points that the scene needs.

Verbs: tracks.track, tracks.fit_tracks, capacity.try_bases, capacity.choose_bases, capacity.choose_stride.
"""
