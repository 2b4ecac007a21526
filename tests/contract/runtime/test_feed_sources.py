"""Sources of live feeds: only what the operator has listed."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.runtime.feed_sources import allowed_hosts
from contract.runtime.settings import Settings
from intrasplat.errors import ErrorCode, InputError

SETTINGS = Settings(
    feed_hosts=("rtsp://camera.example.org", "udp://0.0.0.0:5000"),
    feed_private="yes",
    feed_devices=("/dev/video0", "/srv/demo.mp4"),
)


NO_SOURCES = ("ftp://camera.example.org/", "tcp://x", "", " ")


@pytest.mark.parametrize(
    "source", ["rtsp://user:secret@camera.example.org/1", "rtsp://camera.example.org:554/", "udp://0.0.0.0:5000"]
)
def test_listed_hosts_are_allowed(source: str) -> None:
    hosts = allowed_hosts(source, SETTINGS)
    assert hosts is not None
    assert hosts.permits("192.168.1.2")


@pytest.mark.parametrize("source", ["/srv/demo.mp4", "file:///srv/demo.mp4", "v4l2:///dev/video0"])
def test_listed_files_and_devices_need_no_host(source: str) -> None:
    assert allowed_hosts(source, SETTINGS) is None


def test_a_push_connects_to_nothing() -> None:
    assert allowed_hosts(None, SETTINGS) is not None


@pytest.mark.parametrize(
    "source",
    [
        *(
            "rtsp://other.example.org/1",
            "rtsp://camera.example.org:8554/",
            "http://camera.example.org/",
            "udp://0.0.0.0:1",
        ),
        *(
            "/srv/other.mp4",
            "file:///etc/passwd",
            "/srv/../srv/x/demo.mp4",
            "/srv/x/../demo.mp4",
            "v4l2:///dev/video1",
            "demo.mp4",
            *NO_SOURCES,
        ),
    ],
)
def test_all_else_is_refused(source: str) -> None:
    with pytest.raises(InputError) as refused:
        allowed_hosts(source, SETTINGS)
    assert refused.value.field == "source"
    assert (refused.value.code is ErrorCode.NOT_LISTED) == (source not in NO_SOURCES)
    assert str(Path.cwd()) not in str(refused.value)
    with pytest.raises(InputError):
        allowed_hosts(source, Settings())


@pytest.mark.parametrize(
    ("host", "why"),
    [
        ("camera.example.org", "is not SCHEME://HOST"),
        ("/dev/video0", "is not SCHEME://HOST"),
        ("tcp://camera.example.org", "names no port, which tcp:// needs"),
        ("rtsp://", "names no host"),
        ("rtsp://camera.example.org/#1", "has a fragment"),
        ("ftp://x", "is no source"),
    ],
)
def test_a_setting_that_names_no_host_is_refused_with_its_reason(host: str, why: str) -> None:
    with pytest.raises(InputError, match="FEED_HOSTS") as refused:
        Settings.from_environment({"INTRASPLAT_FEED_HOSTS": host})
    assert why in refused.value.problem
