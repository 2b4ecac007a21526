"""Secrets with which webhooks are signed, one per tenant, and the signature of Standard Webhooks.

All secrets are derived from INTRASPLAT_WEBHOOK_SECRET, so nothing else is stored. A tenant that knows its own secret
cannot forge a webhook for the receiver of another tenant.
"""

from __future__ import annotations

import base64
import hashlib
import hmac

SECRET_PREFIX = "whsec_"
SIGNATURE_VERSION = "v1"


def tenant_secret(webhook_secret: str, tenant: str) -> str:
    """What the tenant's receivers verify webhooks with: whsec_ and 32 bytes in base64.

    The bytes are HMAC-SHA-256 of the tenant's name under the installation's secret.
    """
    secret = hmac.digest(webhook_secret.encode(), f"intrasplat webhook 1 {tenant}".encode(), hashlib.sha256)
    return SECRET_PREFIX + base64.b64encode(secret).decode()


def signature(secret: str, event_id: str, timestamp_s: int, body: bytes) -> str:
    """The header webhook-signature: HMAC-SHA-256 of `id.timestamp.body`. timestamp_s: time of this attempt, UNIX s."""
    key = base64.b64decode(secret.removeprefix(SECRET_PREFIX))
    signed = hmac.digest(key, f"{event_id}.{timestamp_s}.".encode() + body, hashlib.sha256)
    return f"{SIGNATURE_VERSION},{base64.b64encode(signed).decode()}"
