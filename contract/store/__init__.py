"""Clips and scenes in, the same bytes out: on the local disk or in an S3 bucket.

store.py is the store; bucket.py keeps it in S3; durable.py makes a file or folder appear whole or not at all.
"""
