"""Opens the way to a source: resolves and checks its host, connects, and hands the open connection to the process that
reads it, so that this process needs no sockets of its own."""

from __future__ import annotations

import os
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from intrasplat.live.relay import Relay
from intrasplat.live.spec import AllowedHosts, SourceKind, SourceSpec, Target, bracketed
from intrasplat.live.state import FeedReason

BUFFER_BYTES = 4 << 20  # of a socket; a second of 32 Mbit/s, while the reading process starts or the disk is slow
PIPE_BYTES = 1 << 20


class ConnectionFailed(Exception):
    """There is no way to the source at the moment."""

    def __init__(self, reason: FeedReason, text: str) -> None:
        super().__init__(text)
        self.reason, self.text = reason, text


@dataclass
class Connection:
    """A way to the source.

    request  what the reading process is asked to open (intrasplat/live/reading.py)
    passed   file descriptors that it inherits
    push     the end of the pipe that a pushing caller writes to; None: nobody pushes
    relay    of a connection by RTSP or TLS
    made_at  UNIX time, s
    """

    request: dict[str, Any]
    passed: tuple[int, ...] = ()
    push: int | None = None
    relay: Relay | None = None
    made_at: float = field(default_factory=time.time)
    _closes: list[Callable[[], None]] = field(default_factory=list)

    def close_passed(self) -> None:
        """Close our copies of what the reading process has inherited."""
        while self._closes:
            self._closes.pop()()

    def close(self) -> None:
        """Close everything but the push end."""
        self.close_passed()
        if self.relay is not None:
            self.relay.close()


def connect(target: Target, spec: SourceSpec) -> Connection:
    """A connection to the source.

    Raises:
        ConnectionFailed: the host cannot be resolved, is not allowed, or does not answer in time.
    """
    kind = target.kind
    if kind in (SourceKind.PUSH, SourceKind.PICTURES):
        return _pipe(pictures=kind is SourceKind.PICTURES)
    if kind is SourceKind.FILE:
        return Connection({"file": target.path, "readable": [target.path]})
    if kind is SourceKind.DEVICE:
        return Connection({"device": target.path, "options": spec.device_options})
    try:
        address = _address(target, spec.hosts, spec.deadlines.connect_s)
        if kind is SourceKind.UDP:
            return _inherited(_bound(address, target.port), {"datagrams": True})
        connected = socket.create_connection((address, target.port), spec.deadlines.connect_s)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise ConnectionFailed(FeedReason.UNREACHABLE, f"{target.origin} does not answer: {reason}") from error
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    if target.is_secure:
        connected = _secured(connected, target)
    connected.settimeout(None)
    if kind is SourceKind.RTSP:
        relay = Relay(connected)
        url = f"rtsp://{target.user}127.0.0.1:{relay.port}{target.path}"
        return Connection({"rtsp": url, "port": relay.port}, relay=relay)
    if kind is SourceKind.TCP:
        return _inherited(connected, {})
    http = {"http": {"host": f"{bracketed(target.host)}:{target.port}", "path": target.path}}
    if not target.is_secure:
        return _inherited(connected, http)
    ours, theirs = socket.socketpair()
    connection = _inherited(theirs, http)
    connection.relay = Relay(connected, ours)
    return connection


def _pipe(pictures: bool) -> Connection:
    read, write = os.pipe()
    try:
        import fcntl

        fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    except (AttributeError, OSError, ImportError):  # a smaller one will do
        pass
    os.set_blocking(write, False)
    return Connection({"input": read, "pictures": pictures}, (read,), write, _closes=[lambda: os.close(read)])


def _inherited(connected: socket.socket, request: dict[str, Any]) -> Connection:
    number = connected.fileno()
    return Connection(request | {"input": number}, (number,), _closes=[connected.close])


def _secured(connected: socket.socket, target: Target) -> socket.socket:
    try:
        return ssl.create_default_context().wrap_socket(connected, server_hostname=target.host)
    except (OSError, ValueError) as error:
        connected.close()
        problem = f"the connection to {target.origin} cannot be secured: {error}"
        raise ConnectionFailed(FeedReason.UNREACHABLE, problem) from error


def _bound(address: str, port: int) -> socket.socket:
    """A socket that receives what is sent to an address of this machine, or to a group."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_DGRAM)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        is_group = _is_group(address)
        if is_group:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((address, port))
        if is_group and family == socket.AF_INET:
            joined = struct.pack("=4s4s", socket.inet_aton(address), bytes(4))
            bound.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, joined)
        elif is_group:
            joined = struct.pack("=16sI", socket.inet_pton(family, address), 0)
            bound.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, joined)
    except OSError:
        bound.close()
        raise
    return bound


def _is_group(address: str) -> bool:
    return address.lower().startswith("ff") if ":" in address else 224 <= int(address.partition(".")[0]) < 240


def _address(target: Target, hosts: AllowedHosts | None, limit_s: float) -> str:
    """The first allowed address of the target's host. An address to receive at is this machine's own."""
    addresses = _resolved(target.host, limit_s)
    if hosts is None or target.kind is SourceKind.UDP:
        return addresses[0]
    permitted = [each for each in addresses if hosts.permits(each)]
    if not permitted:
        problem = f"{bracketed(target.host)} has no address that is allowed"
        raise ConnectionFailed(FeedReason.HOST_REFUSED, problem)
    return permitted[0]


def _resolved(host: str, limit_s: float) -> list[str]:
    """The addresses of a host. A resolver that does not answer is left alone after limit_s."""
    found: list[list[str] | Exception] = []

    def ask() -> None:
        try:
            answer = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
            found.append(list(dict.fromkeys(str(each[4][0]) for each in answer)))
        except (OSError, UnicodeError) as error:
            found.append(error)

    asking = threading.Thread(target=ask, name="look-up", daemon=True)
    asking.start()
    asking.join(limit_s)
    answer = found[0] if found else TimeoutError("its name is not resolved in time")
    if isinstance(answer, Exception):
        raise answer
    return answer
