"""Who may do what, and who did it: API keys, the audit log, the keys of the render connection."""
