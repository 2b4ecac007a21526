"""What a caller says about a source: where it is, how its pictures hold two eyes, what is recorded, which hosts are
allowed."""

from __future__ import annotations

import random
import re
import struct
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal
from urllib.parse import SplitResult, quote, unquote, urlsplit

from intrasplat.errors import InputError, NotListedError
from intrasplat.intake.addresses import is_permitted
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.video_header import EBML, is_video

FIELD = "source"
MAX_URL_CHARACTERS = 2000
MAX_KEEP_S = 7 * 86400.0
"""The longest past of a feed."""
FeedLayout = Literal["auto", "sbs", "tb", "two"]
"""How two eyes arrive: side by side, top-bottom, as two streams of one source; auto finds it."""

PICTURE_HEADER = struct.Struct("<dI")
"""Before each pushed picture: the sender's time, s, or NaN; bytes."""

TS_SYNC = b"\x47"
"""The first byte of MPEG-TS, which a reader may join anywhere. Other streams begin with a head that it must have."""
STREAM_HEAD_BYTES = 8
"""So many first bytes of a stream tell its format."""

_URL_TEXT = re.compile(r"[!-~]+", re.ASCII)
_PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443, "tcp": None, "udp": None}
_REMEDY = (
    "Give rtsp://, rtsps://, tcp://HOST:PORT, udp://ADDRESS:PORT, http://, https://, the path of a file, or v4l2:///dev/"
    "video0."
)


class SourceKind(StrEnum):
    """How a source is read."""

    RTSP = "rtsp"
    TCP = "tcp"
    UDP = "udp"
    HTTP = "http"
    FILE = "file"
    DEVICE = "device"
    PUSH = "push"
    PICTURES = "pictures"


@dataclass(frozen=True)
class Target:
    """A parsed source. host and port are those of a URL; path is a file, a device, or the rest of a URL."""

    kind: SourceKind
    scheme: str = ""
    host: str = ""
    port: int = 0
    path: str = ""
    user: str = ""
    """user:password@, as it stands in the URL."""

    @property
    def is_secure(self) -> bool:
        """Whether the connection is encrypted."""
        return self.scheme in ("rtsps", "https")

    @property
    def origin(self) -> str:
        """Scheme, host and port."""
        return f"{self.scheme}://{bracketed(self.host)}:{self.port}"


@dataclass(frozen=True)
class AllowedHosts:
    """Hosts that sources may be read from.

    origins  such as rtsp://camera.example.org or udp://0.0.0.0:5000; the port may be left out where the scheme has one
    private  whether their addresses may be this machine's or a private network's
    """

    origins: tuple[str, ...] = ()
    private: bool = False

    def has(self, target: Target) -> bool:
        """Whether a target's scheme, host and port are listed."""
        return target.origin in {parsed(each).origin for each in self.origins}

    def permits(self, address: str) -> bool:
        """Whether connections may go to an address."""
        return is_permitted(address, self.private)


@dataclass(frozen=True)
class RecordingSpec:
    """What is recorded.

    folder     of this feed alone
    keep_s     a part is deleted this long after its last packet came in
    part_s     least seconds of a part, which begins at a key frame; a crash loses the part that is being written
    max_bytes  of all parts: the oldest ones go first
    """

    folder: Path
    keep_s: float = 3600.0
    part_s: float = 2.0
    max_bytes: int = 8 << 30


@dataclass(frozen=True)
class Deadlines:
    """Time limits of a connection, s.

    connect_s  to resolve a name, each, and to connect
    first_s    from there to the first pair
    silent_s   without a packet, or without a picture, until the feed counts as stalled
    read_s     the same, until the connection is given up
    """

    connect_s: float = 5.0
    first_s: float = 10.0
    silent_s: float = 2.0
    read_s: float = 8.0


@dataclass(frozen=True)
class BackOff:
    """Seconds between connections: first_s, then twice as many each time, up to most_s; up to half less by chance."""

    first_s: float = 0.5
    most_s: float = 4.0

    def pause_s(self, failures: int) -> float:
        """Seconds after so many failures in a row, counted from 0."""
        longest_s = min(self.most_s, self.first_s * 2.0 ** min(failures, 30))
        return longest_s * random.uniform(0.5, 1.0)


@dataclass(frozen=True)
class SourceSpec:
    """A source.

    url             where it is; None: the caller pushes it (Source.write, Source.write_picture)
    pictures        whether a push consists of single pictures, each of two eyes
    hosts           hosts that are allowed; None: all, for a user on their own machine
    device_options  FFmpeg's options of a capture device, such as input_format and framerate
    limits          of pictures
    """

    url: str | None
    pictures: bool = False
    layout: FeedLayout = "auto"
    recording: RecordingSpec | None = None
    hosts: AllowedHosts | None = None
    deadlines: Deadlines = Deadlines()
    back_off: BackOff = BackOff()
    device_options: dict[str, str] = field(default_factory=dict)
    limits: ClipLimits = field(default_factory=ClipLimits)

    def target(self) -> Target:
        """The source, checked as far as that is possible without a connection.

        Raises:
            NotListedError: it, or its host, is not allowed.
            InputError: it is no source, or its file is missing.
        """
        if self.url is None:
            return Target(SourceKind.PICTURES if self.pictures else SourceKind.PUSH)
        target = parsed(self.url)
        if target.kind in (SourceKind.FILE, SourceKind.DEVICE):
            if self.hosts is not None:
                raise NotListedError(FIELD, "files and devices of the service's machine are not allowed.", _REMEDY)
            if not Path(target.path).exists():
                raise InputError(FIELD, f"there is no {target.path}.", _REMEDY)
        elif self.hosts is not None and not self.hosts.has(target):
            raise NotListedError(
                FIELD, f"{target.origin[:80]} is not allowed.", "Whoever runs the service lists hosts."
            )
        return target


def parsed(url: str) -> Target:
    """The target that a URL or a path names.

    Raises:
        InputError: it is none.
    """
    if not url.strip():
        raise InputError(FIELD, "it is empty.", "Name a source; over HTTP leave it out for a push.")
    scheme = url.partition("://")[0].lower() if "://" in url else "file"
    if scheme in ("file", "v4l2"):
        path = url.partition("://")[2] if "://" in url else url
        is_device = scheme == "v4l2" or path.startswith("/dev/")
        path = unquote(path) if "://" in url else path
        return Target(SourceKind.DEVICE if is_device else SourceKind.FILE, path=str(Path(path).absolute()))
    if scheme not in _PORTS or len(url) > MAX_URL_CHARACTERS or not _URL_TEXT.fullmatch(url):
        raise InputError(FIELD, f"{without_user(url)[:80]!r} is no source.", _REMEDY)
    try:
        parts = urlsplit(url)
        port = parts.port or _PORTS[scheme]
    except ValueError:
        raise InputError(FIELD, f"{without_user(url)[:80]!r} is no source.", _REMEDY) from None
    if not parts.hostname or port is None or parts.fragment:
        lacks = "names no host" if not parts.hostname else f"names no port, which {scheme}:// needs"
        problem = "has a fragment (what comes after #)" if parts.fragment else lacks
        raise InputError(FIELD, f"{without_user(url)[:80]!r} {problem}.", _REMEDY)
    kind = SourceKind(scheme.removesuffix("s"))
    user = parts.netloc.rpartition("@")[0]
    if user and kind is not SourceKind.RTSP:
        raise InputError(FIELD, "only rtsp:// and rtsps:// may name a user.", _REMEDY)
    return Target(kind, scheme, parts.hostname, port, _rest(parts), user and f"{user}@")


def without_user(url: str) -> str:
    """The URL without the user and password that it may name."""
    return re.sub(r"//[^/@]*@", "//", url)


def bracketed(host: str) -> str:
    """A host as it stands in a URL."""
    return f"[{host}]" if ":" in host else host


def _rest(parts: SplitResult) -> str:
    path = quote(parts.path, safe="/%:;=@!$&'()*+,~") or "/"
    return f"{path}?{parts.query}" if parts.query else path


def stream_format(head: bytes) -> str | None:
    """FFmpeg's demuxer of a stream with these first STREAM_HEAD_BYTES; None: not MPEG-TS, mp4 or Matroska."""
    if head.startswith(TS_SYNC):
        return "mpegts"
    if head.startswith(EBML):
        return "matroska"
    return "mov" if is_video(head) or head[4:8] in (b"styp", b"moof") else None
