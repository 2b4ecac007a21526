"""Python client, command line and dashboard. No torch at import.

from client import Client         # blocking
from client import AsyncClient    # the same, to be awaited
"""

from client.api import Client
from client.async_api import AsyncClient
from client.errors import (
    Conflict,
    Forbidden,
    JobCancelled,
    JobFailed,
    JobRejected,
    NotFound,
    RateLimited,
    RequestRefused,
    ServiceFault,
    ServiceUnavailable,
    Unauthorized,
)
from client.views import Image

__all__ = [
    "AsyncClient",
    "Client",
    "Conflict",
    "Forbidden",
    "Image",
    "JobCancelled",
    "JobFailed",
    "JobRejected",
    "NotFound",
    "RateLimited",
    "RequestRefused",
    "ServiceFault",
    "ServiceUnavailable",
    "Unauthorized",
]
