"""The Python client of an intrasplat service. It needs httpx, websockets and pydantic; numpy for arrays only.

from intrasplat_client import Client         # blocking
from intrasplat_client import AsyncClient    # the same methods, to be awaited

client.py, async_client.py         the two clients
core.py, feeds.py                  every route, written once for both
submission.py, events.py           sending a clip; following a job
views.py, viewer.py                one view; many views over one connection
session.py, connection.py          repeating calls; a call on a connection that blocks or awaits
errors.py, models.py               what can go wrong; the service's types, generated
"""

from intrasplat_client.async_client import AsyncClient
from intrasplat_client.client import Client
from intrasplat_client.errors import (
    Conflict,
    Forbidden,
    InputError,
    IntrasplatError,
    JobCancelled,
    JobFailed,
    JobRejected,
    NotFound,
    RateLimited,
    RequestRefused,
    ServiceFault,
    ServiceUnavailable,
    Unauthorized,
    Unreachable,
)
from intrasplat_client.feeds import CutJob
from intrasplat_client.models import (
    ErrorCode,
    FeedReceipt,
    FeedState,
    FeedView,
    JobOptions,
    JobState,
    JobView,
    Measurement,
    Notice,
    NoticeCode,
    Report,
    SceneCameras,
)
from intrasplat_client.views import Image

__all__ = [
    "AsyncClient",
    "Client",
    "Conflict",
    "CutJob",
    "ErrorCode",
    "FeedReceipt",
    "FeedState",
    "FeedView",
    "Forbidden",
    "Image",
    "InputError",
    "IntrasplatError",
    "JobCancelled",
    "JobFailed",
    "JobOptions",
    "JobRejected",
    "JobState",
    "JobView",
    "Measurement",
    "NotFound",
    "Notice",
    "NoticeCode",
    "RateLimited",
    "Report",
    "RequestRefused",
    "SceneCameras",
    "ServiceFault",
    "ServiceUnavailable",
    "Unauthorized",
    "Unreachable",
]
