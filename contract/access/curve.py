"""Keys of the encrypted connections between services and workers, made from the one secret that both are given.

ZeroMQ's CURVE has a pair of Curve25519 keys on each side. Whoever knows INTRASPLAT_RENDER_SECRET can make both pairs,
so nothing else need be handed around; whoever does not can neither ask a worker nor pass for one.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field

import zmq
from zmq.utils import z85


@dataclass(frozen=True)
class CurveKeys:
    """One side's pair, in Z85 as ZeroMQ has it."""

    public: bytes
    secret: bytes = field(repr=False)


def service_keys(render_secret: str) -> CurveKeys:
    """The pair of every service."""
    return _keys(render_secret, b"intrasplat service 1")


def worker_keys(render_secret: str) -> CurveKeys:
    """The pair of every worker."""
    return _keys(render_secret, b"intrasplat worker 1")


def _keys(render_secret: str, label: bytes) -> CurveKeys:
    """Each label's own 32 bytes: HMAC-SHA-256 of it under the secret, of which any is a Curve25519 secret key."""
    secret = z85.encode(hmac.digest(render_secret.encode(), label, hashlib.sha256))
    return CurveKeys(zmq.curve_public(secret), secret)
