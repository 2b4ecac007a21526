"""Python client, command line and dashboard. No torch at import.

from client import Client         # blocking
from client import AsyncClient    # the same, to be awaited

errors.py                             what can go wrong
steps.py, connection.py               what a client does, one step at a time; how a step goes over HTTP
submission.py, watching.py, views.py  sending a clip; following a job; asking for a view
calls.py, api.py, async_api.py        every route as steps; the two clients, which take them
viewer.py                             many views over one connection
cli.py; remote.py, keys.py, up.py     the command line; its commands
demo.py, pictures.py; dashboard/      `make demo`; the page for the browser
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
