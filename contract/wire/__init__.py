"""What travels between processes and callers: jobs and their options, rendering requests, poses, reports, errors.

Pydantic and the standard library only; nothing else of this repository is imported.
"""
