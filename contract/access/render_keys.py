"""Key pairs of the encrypted render connection between services and workers, derived from their shared secret.

ZeroMQ's CURVE encryption needs a pair of Curve25519 keys on each side. Both pairs follow from INTRASPLAT_RENDER_SECRET,
so no other key has to be distributed. Without the secret, nobody can send a request to a worker or pose as one.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field

import zmq
from zmq.utils import z85


@dataclass(frozen=True)
class RenderKeys:
    """One side's key pair, in Z85 as ZeroMQ takes it."""

    public: bytes
    secret: bytes = field(repr=False)


def service_keys(render_secret: str) -> RenderKeys:
    """The pair of every service."""
    return _keys(render_secret, b"intrasplat service 1")


def worker_keys(render_secret: str) -> RenderKeys:
    """The pair of every worker."""
    return _keys(render_secret, b"intrasplat worker 1")


def _keys(render_secret: str, label: bytes) -> RenderKeys:
    """The secret key is HMAC-SHA-256 of the label under the secret: any 32 bytes are a Curve25519 secret key."""
    secret = z85.encode(hmac.digest(render_secret.encode(), label, hashlib.sha256))
    return RenderKeys(zmq.curve_public(secret), secret)
