"""API keys, what each key may do, and the audit log.

`KeyFile` creates, finds and revokes API keys. `check_keys` raises if other machines can reach a service without keys
(keys.py). `AuditLog.append` records an action before it takes place (audit.py). `service_keys` and `worker_keys` give
the key pairs that encrypt the render connection (render_keys.py).
"""
