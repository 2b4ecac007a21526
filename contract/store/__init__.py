"""The store of clips and scenes, for one machine or many.

`open_store(settings)` returns the `Store` (store.py). It keeps accepted clips and finished scenes on a `Shelf`
(shelf.py): the disk (local.py) or an S3 bucket (s3.py).
"""
