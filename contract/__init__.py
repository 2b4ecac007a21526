"""What more than one process must agree on. Pydantic and the standard library only: no torch, no fastapi."""

CONTRACT_VERSION = 2
"""Raised by one whenever a stored or sent shape changes incompatibly."""
