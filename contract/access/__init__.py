"""A caller's key in, what it may do out, and a line for whoever asks later who did what.

`KeyFile` creates, finds and revokes API keys, and `check_keys` refuses a service that others can reach without any
(keys.py). `AuditLog.append` records an act before it goes on (audit.py). `service_keys` and `worker_keys` encrypt the
render connection (render_keys.py).
"""
