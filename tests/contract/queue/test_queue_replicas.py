"""The queue behind Sentinels, whose primary dies; and on the nodes of a cluster."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
import redis

from contract.queue.interface import Claim, Order
from contract.queue.redis_queue import RedisQueue
from contract.wire.errors import UnavailableError
from contract.wire.job import JobRecord, JobState
from tests.contract.queues import TRAINING, RunningServer, claimed, free_port, job, known, redis_binary, state_of

PASSWORD = "of-the-test"
NAME = "theatre"
SERVER = {
    "bind": "127.0.0.1",
    "requirepass": PASSWORD,
    "masterauth": PASSWORD,
    "repl_diskless_sync_delay": "0",
    "min_replicas_to_write": "1",
    "min_replicas_max_lag": "5",
}
"""As docs/operations.md asks of each server."""
PATIENCE_S = 30.0


def eventually(happens: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not happens():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


@pytest.fixture
def server_program() -> Path:
    found = redis_binary()
    if found is None:
        pytest.skip("no redis-server on PATH")
    return found


class Replicated:
    """A primary, two replicas of which one must hear every change, and three Sentinels of which two must agree."""

    def __init__(self, program: Path, folder: Path, ended: ExitStack) -> None:
        self.servers: dict[int, RunningServer] = {}
        self.first_port = free_port()
        for port in (self.first_port, free_port(), free_port()):
            settings = SERVER if port == self.first_port else {**SERVER, "replicaof": f"127.0.0.1 {self.first_port}"}
            self.servers[port] = RunningServer(program, folder / str(port), port=str(port), **settings)
            ended.callback(self.servers[port].stop)
        self.sentinels = [free_port() for _ in range(3)]
        for port in self.sentinels:
            ended.callback(_stop, _sentinel(program, folder / f"sentinel-{port}", port, self.first_port))
        eventually(lambda: all(self._is_settled(port) for port in self.sentinels))

    @property
    def url(self) -> str:
        """Of the queue, as an operator writes it."""
        hosts = ",".join(f"127.0.0.1:{port}" for port in self.sentinels)
        return f"redis+sentinel://:{PASSWORD}@{hosts}/{NAME}"

    def primary_port(self) -> int:
        """Of the server that the first Sentinel calls primary now."""
        with redis.Redis(port=self.sentinels[0], decode_responses=True) as client:
            return int(client.sentinel_get_master_addr_by_name(NAME)[1])

    def record(self, port: int, job_id: str) -> JobRecord | None:
        """What one server holds of a job."""
        queue = RedisQueue(f"{self.servers[port].url}?password={PASSWORD}")
        try:
            return queue.get(job_id)
        finally:
            queue.close()

    def replicas_know(self, record: JobRecord) -> bool:
        return all(self.record(port, record.job_id) == record for port in self.servers if port != self.first_port)

    @staticmethod
    def _is_settled(port: int) -> bool:
        """Whether this Sentinel knows both replicas and the other two Sentinels."""
        try:
            with redis.Redis(port=port, decode_responses=True) as client:
                known = client.sentinel_masters()[NAME]
                replicas = client.sentinel_slaves(NAME)
        except redis.ConnectionError:
            return False
        in_step = [each["master-link-status"] == "ok" and not each["is_disconnected"] for each in replicas]
        return known["num-other-sentinels"] == 2 and in_step == [True, True]


def _sentinel(program: Path, folder: Path, port: int, primary_port: int) -> subprocess.Popen[bytes]:
    folder.mkdir()
    settings = folder / "sentinel.conf"
    settings.write_text(
        f"port {port}\nbind 127.0.0.1\ndir {folder}\n"
        f"sentinel monitor {NAME} 127.0.0.1 {primary_port} 2\n"
        f"sentinel auth-pass {NAME} {PASSWORD}\n"
        f"sentinel down-after-milliseconds {NAME} 500\nsentinel failover-timeout {NAME} 5000\n"
    )
    with (folder / "log").open("wb") as log:
        return subprocess.Popen([str(program), str(settings), "--sentinel"], stdout=log, stderr=log)


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    process.wait(20.0)


@pytest.fixture
def replicated(server_program: Path, tmp_path: Path) -> Iterator[Replicated]:
    with ExitStack() as ended:
        yield Replicated(server_program, tmp_path, ended)


def test_a_claimed_job_is_finished_on_the_server_that_the_sentinels_make_primary(replicated: Replicated) -> None:
    queue = RedisQueue(replicated.url)
    waiting = queue.submit(job(2000.0))
    running = queue.submit(job(1000.0, priority="high"))
    record, claim = claimed(queue)
    assert record.job_id == running.job_id
    assert queue.beat(claim, TRAINING) is Order.GO_ON
    eventually(lambda: replicated.replicas_know(known(queue, running.job_id)))

    replicated.servers[replicated.first_port].kill()
    orders: list[Order] = []

    def beats() -> bool:
        with suppress(UnavailableError):
            orders.append(queue.beat(claim, TRAINING))
        return bool(orders)

    eventually(beats)
    assert orders == [Order.GO_ON]
    assert replicated.primary_port() != replicated.first_port
    assert queue.finish(claim)
    assert state_of(queue, running.job_id) is JobState.DONE
    assert claimed(queue)[0].job_id == waiting.job_id
    queue.close()


def test_a_job_that_ends_while_its_primary_is_replaced_ends_once_on_the_next(replicated: Replicated) -> None:
    """What the primary took after its heir was chosen is lost: the worker claims and ends the job again."""
    queue = RedisQueue(replicated.url)
    first = queue.submit(job())
    eventually(lambda: replicated.replicas_know(first))
    with redis.Redis(port=replicated.sentinels[0], decode_responses=True) as sentinel:
        sentinel.sentinel_failover(NAME)
    eventually(lambda: replicated.primary_port() != replicated.first_port)

    def ends() -> bool:
        with suppress(UnavailableError):
            if record := queue.claim("worker-1", 0.0):  # by a connection that was open before
                queue.finish(Claim(record.job_id, record.attempt, "worker-1"))
        found = replicated.record(replicated.primary_port(), first.job_id)
        return found is not None and found.state is JobState.DONE

    eventually(ends)
    states = [event.record.state for event in queue.events(first.job_id)]
    assert states == [JobState.QUEUED, JobState.RUNNING, JobState.DONE]
    queue.close()


def test_of_a_cluster_only_the_node_that_holds_the_queue_serves_and_the_others_say_so(
    server_program: Path, tmp_path: Path
) -> None:
    with ExitStack() as ended:
        nodes = []
        for _ in range(3):
            ports = {"port": str(free_port()), "cluster_port": str(free_port())}
            node = RunningServer(
                server_program, tmp_path / ports["port"], cluster_enabled="yes", bind="127.0.0.1", **ports
            )
            ended.callback(node.stop)
            nodes.append((node, ports))
        clients = [ended.enter_context(node.client()) for node, _ in nodes]
        for client, (first, last) in zip(clients, [(0, 5460), (5461, 10922), (10923, 16383)], strict=True):
            client.execute_command("CLUSTER", "ADDSLOTSRANGE", first, last)
        for _, ports in nodes[1:]:
            clients[0].execute_command("CLUSTER", "MEET", "127.0.0.1", ports["port"], ports["cluster_port"])
        eventually(lambda: all("cluster_state:ok" in str(each.execute_command("CLUSTER", "INFO")) for each in clients))

        queues = [RedisQueue(node.url) for node, _ in nodes]
        refusals: list[UnavailableError] = []
        for queue in queues:
            ended.callback(queue.close)
            try:
                queue.submit(job())
            except UnavailableError as error:
                refusals.append(error)
        assert [error.problem for error in refusals] == ["The queue's server refuses (MOVED)."] * 2
        assert all("no cluster's" in error.remedy and not error.may_return for error in refusals)
