"""Backups: a running installation is copied into a folder, from which another machine can continue.

`take_backup` writes a backup (take.py), `restore_backup` fills an empty data directory and an empty queue from one
(restore.py). manifest.py holds the format. The queue's records are read and written through its interface alone.
"""
