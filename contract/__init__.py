"""What several processes must agree on, in rooms that import only those before them.

wire/ (what is sent and stored), runtime/ (settings, logs, child processes), intake/ (files from outside), store/ (clips
and scenes), queue/ (jobs), access/ (keys and audit). No torch, no web framework.
"""

CONTRACT_VERSION = 2
"""Raised by one whenever a stored or sent shape changes incompatibly."""
