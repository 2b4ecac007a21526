"""What service and worker must agree on. A folder imports only the folders named before it.

wire/ (what is sent and stored), runtime/ (settings, logs, child processes), store/ (clips and scenes), queue/ (jobs),
access/ (keys and audit), backup/ (backup and restore). No torch, no web framework.
"""

CONTRACT_VERSION = 2
"""Raised by one whenever a stored or sent shape changes incompatibly."""
