"""REDIS_URL names a server or its Sentinels; what it cannot name is refused, and never repeated."""

from __future__ import annotations

import pytest

from contract.queue.redis_queue import RedisQueue
from contract.runtime.queue_url import QueueUrl, parse_queue_url
from contract.runtime.settings import Settings
from intrasplat.errors import InputError


def test_the_url_of_a_server_stays_as_it_is() -> None:
    for url in ("redis://queue:6379/0", "rediss://a:b@queue?ssl_ca_certs=/ca.pem", "unix:///run/queue.sock"):
        assert parse_queue_url(url) == QueueUrl(url)


def test_sentinels_are_told_apart_from_user_options_and_name() -> None:
    read = parse_queue_url("rediss+sentinel://me:p%2Fw@one,two:26380,[::1]:1/theatre?ssl_ca_certs=/ca.pem")
    assert read.sentinels == (("one", 26379), ("two", 26380), ("::1", 1))
    assert read.primary == "theatre"
    assert read.url == "rediss://me:p%2Fw@one?ssl_ca_certs=/ca.pem"


@pytest.mark.parametrize(
    "url",
    [
        "redis+cluster://u:secret@one,two",
        "unix+sentinel://u:secret@/name",
        "http://u:secret@one",
        "redis+sentinel://u:secret@one",
        "redis+sentinel://u:secret@one/name/0",
        "redis+sentinel://u:secret@one,:26379/name",
        "redis+sentinel://u:secret@one:port/name",
        "redis+sentinel://u:secret@[one/name",
    ],
)
def test_a_url_of_another_kind_is_refused_at_the_start_without_being_repeated(url: str) -> None:
    with pytest.raises(InputError, match="REDIS_URL") as refused:
        Settings.from_environment({"REDIS_URL": url})
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize(
    "url",
    [
        "redis://u:sec/ret@one",
        "redis+sentinel://one/name?socket_timeout=secret",
        "redis://u:secret@one?no_such_option=1",
        "unix:///run/queue.sock?no_such_option=secret",
        "redis+sentinel://u:secret@one/name?no_such_option=1",
    ],
)
def test_a_password_or_option_that_cannot_be_read_is_refused_without_being_repeated(url: str) -> None:
    with pytest.raises(InputError, match="REDIS_URL") as refused:
        RedisQueue(url)
    assert "sec" not in str(refused.value)
