"""Where live feeds may be read from: hosts, files and devices that the operator has listed."""

from __future__ import annotations

from contract.runtime.settings import Settings
from intrasplat.errors import NotListedError
from intrasplat.live.spec import FIELD, AllowedHosts, SourceKind, parsed, without_user

HOSTS_REMEDY = "Whoever runs the service names hosts in INTRASPLAT_FEED_HOSTS."
DEVICES_REMEDY = "Whoever runs the service names files and devices of a worker's machine in INTRASPLAT_FEED_DEVICES."


def allowed_hosts(source: str | None, settings: Settings) -> AllowedHosts | None:
    """The hosts that a source may connect to, as SourceSpec takes them; None: a file or device that is listed.

    source None: a push, which connects to nothing.

    Raises:
        NotListedError: it is not listed.
        InputError: it is no source.
    """
    hosts = AllowedHosts(settings.feed_hosts, settings.feed_private == "yes")
    if source is None:
        return hosts
    target = parsed(source)
    if target.kind in (SourceKind.FILE, SourceKind.DEVICE):
        if target.path not in settings.feed_devices:
            raise NotListedError(FIELD, f"{without_user(source)[:80]!r} is not allowed.", DEVICES_REMEDY)
        return None
    if not hosts.has(target):
        raise NotListedError(FIELD, f"{target.origin[:80]} is not allowed.", HOSTS_REMEDY)
    return hosts
