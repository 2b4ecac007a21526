"""Depth clip in; tracks of its tissue out, and how many bases and points the scene needs.

Verbs: tracks.track, tracks.fit_tracks, capacity.try_bases, capacity.choose_bases, capacity.choose_stride.
"""
