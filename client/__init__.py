"""Python client, command line and dashboard. No torch at import.

from client import Client
"""

from client.api import Client, Image
from client.errors import JobCancelled, JobFailed, JobRejected, RequestRefused, ServiceFault

__all__ = ["Client", "Image", "JobCancelled", "JobFailed", "JobRejected", "RequestRefused", "ServiceFault"]
