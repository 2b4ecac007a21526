"""Jobs in, claims out: the queue that every service and worker shares.

promise.py states what a queue guarantees; memory.py and redis_queue.py keep it; scripts.py holds each atomic change:
CLAIM and BEAT are the lease; embedded.py starts a private Valkey.
"""
