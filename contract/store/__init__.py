"""Clips and scenes in, the same bytes out, on one machine or on many.

`open_store(settings)` gives the `Store`. It keeps what was accepted and finished on a `Shelf` (shelf.py): the disk
(local.py) or an S3 bucket (s3.py). `replace_file` and `move_folder` (durable.py) are the only durable writes.
"""
