"""Jobs in, claims out: the queue that every service and worker shares.

`Queue` (interface.py) states what submit, claim, beat, finish, fail, release and cancel guarantee. RedisQueue
implements it. scripts/ holds each atomic change on Redis; claim.lua and beat.lua are the lease. `EmbeddedServer` starts
a private Valkey.
"""
