"""Untrusted files in; nothing out, or an error that says why they cannot be a clip. No decoder is needed.

Verbs: sniff.check_file, video_header.check_video, zips.open_zip, limits.ClipLimits.check_clip.
"""
