"""The queue behind Sentinels, whose primary dies; and on the nodes of a cluster."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import redis

from contract.queue.interface import Claim, Order
from contract.queue.redis_queue import RedisQueue
from contract.wire.job import JobRecord, JobState
from intrasplat.errors import UnavailableError
from tests.contract.queues import TRAINING, RunningServer, claimed, free_port, job, known, redis_binary, state_of
from tests.test_repository import REPOSITORY

PASSWORD = "of-the-test"
"""Of the users of servers and Sentinels, but for those who ask Sentinels."""
ASKING = "of-who-asks"
NAME = "theatre"
SENTINEL_CONF = (REPOSITORY / "docker" / "sentinel.conf").read_text(encoding="utf-8")
OPERATIONS = (REPOSITORY / "docs" / "operations.md").read_text(encoding="utf-8")
SERVER = {
    "bind": "127.0.0.1",
    "masteruser": "replica",
    "masterauth": PASSWORD,
    "replica_announce_ip": "localhost",
    "repl_diskless_sync_delay": "0",
    "min_replicas_to_write": "1",
    "min_replicas_max_lag": "5",
    "tls_auth_clients": "no",
    "tls_replication": "yes",
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
    """A primary, two replicas of which one must hear every change, and three Sentinels of which two must agree.

    Users and Sentinels are those of docs/operations.md and docker/sentinel.conf, all over TLS.
    """

    def __init__(self, program: Path, certificates: Path, folder: Path, ended: ExitStack) -> None:
        self._certificate = certificates / "cert.pem"
        users = folder / "users.acl"
        users.write_text("user default off\n" + "\n".join(users_of_servers()) + "\n")
        tls = {
            "tls_cert_file": str(self._certificate),
            "tls_key_file": str(certificates / "key.pem"),
            "tls_ca_cert_file": str(self._certificate),
        }
        self.servers: dict[int, RunningServer] = {}
        self.first_port = free_port()
        for port in (self.first_port, free_port(), free_port()):
            settings = SERVER | tls | {"tls_port": str(port), "aclfile": str(users)}
            if port != self.first_port:
                settings["replicaof"] = f"localhost {self.first_port}"
            self.servers[port] = RunningServer(program, folder / str(port), **settings)
            ended.callback(self.servers[port].stop)
        self.sentinels = [free_port() for _ in range(3)]
        for port in self.sentinels:
            own = {"tls-port": str(port), "dir": str(folder / f"sentinel-{port}")}
            own |= {name.replace("_", "-"): value for name, value in tls.items()}
            ended.callback(_stop, _sentinel(program, own, self.first_port))
        eventually(lambda: all(self._is_settled(port) for port in self.sentinels))

    def url(self, user: str = f"intrasplat:{PASSWORD}", asks: str = "intrasplat", by: str = ASKING) -> str:
        """Of the queue, as an operator writes it."""
        hosts = ",".join(f"localhost:{port}" for port in self.sentinels)
        options = f"ssl_ca_certs={self._certificate}&sentinel_username={asks}&sentinel_password={by}"
        return f"rediss+sentinel://{user}@{hosts}/{NAME}?{options}"

    def sentinel(self, port: int, user: str = "sentinel", password: str = PASSWORD) -> redis.Redis:
        """A client of that Sentinel, with all rights unless another user is named."""
        given: dict[str, Any] = {"username": user, "password": password, "ssl_ca_certs": str(self._certificate)}
        return redis.Redis("localhost", port, ssl=True, decode_responses=True, **given)

    def primary_port(self) -> int:
        """Of the server that the first Sentinel calls primary now."""
        with self.sentinel(self.sentinels[0]) as client:
            return int(client.sentinel_get_master_addr_by_name(NAME)[1])

    def record(self, port: int, job_id: str) -> JobRecord | None:
        """What one server holds of a job."""
        queue = RedisQueue(f"{self.servers[port].url}?username=intrasplat&password={PASSWORD}")
        try:
            return queue.get(job_id)
        finally:
            queue.close()

    def replicas_know(self, record: JobRecord) -> bool:
        return all(self.record(port, record.job_id) == record for port in self.servers if port != self.first_port)

    def _is_settled(self, port: int) -> bool:
        """Whether this Sentinel knows both replicas and the other two Sentinels."""
        try:
            with self.sentinel(port) as client:
                known = client.sentinel_masters()[NAME]
                replicas = client.sentinel_slaves(NAME)
        except redis.ConnectionError:
            return False
        in_step = [each["master-link-status"] == "ok" and not each["is_disconnected"] for each in replicas]
        return known["num-other-sentinels"] == 2 and in_step == [True, True]


def users_of_servers() -> list[str]:
    """Lines of a server's access list: all users that docs/operations.md names."""
    digest = sha256(PASSWORD.encode()).hexdigest()
    lines = re.findall(r"^ *(user \w+ on #SHA256_OF_PASSWORD .*)$", OPERATIONS, re.MULTILINE)
    return [line.replace("SHA256_OF_PASSWORD", digest) for line in lines]


def _sentinel(program: Path, own: dict[str, str], primary_port: int) -> subprocess.Popen[bytes]:
    """A Sentinel by docker/sentinel.conf with its own names, ports and passwords, which finds out sooner."""
    text = SENTINEL_CONF.replace("ASKING_PASSWORD", ASKING)
    text = re.sub(r"\w+_PASSWORD", PASSWORD, text)
    text = text.replace("one.example 6379", f"localhost {primary_port}")
    for name, value in own.items():
        text, times = re.subn(rf"^{name} .*$", f"{name} {value}", text, flags=re.MULTILINE)
        assert times == 1
    text = text.replace(f"{NAME} 5000", f"{NAME} 500").replace(f"{NAME} 60000", f"{NAME} 5000")
    folder = Path(own["dir"])
    folder.mkdir()
    settings = folder / "sentinel.conf"
    settings.write_text(f"{text}\nbind 127.0.0.1\n")
    with (folder / "log").open("wb") as log:
        return subprocess.Popen([str(program), str(settings), "--sentinel"], stdout=log, stderr=log)


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    process.wait(20.0)


@pytest.fixture
def replicated(server_program: Path, certificates: Path, tmp_path: Path) -> Iterator[Replicated]:
    with ExitStack() as ended:
        yield Replicated(server_program, certificates, tmp_path, ended)


def test_a_claimed_job_is_finished_on_the_server_that_the_sentinels_make_primary(replicated: Replicated) -> None:
    queue = RedisQueue(replicated.url())
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
    queue = RedisQueue(replicated.url())
    first = queue.submit(job())
    eventually(lambda: replicated.replicas_know(first))
    with replicated.sentinel(replicated.sentinels[0]) as sentinel:
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


def refusal(url: str) -> UnavailableError:
    queue = RedisQueue(url)
    try:
        with pytest.raises(UnavailableError) as refused:
            queue.ping()
        return refused.value
    finally:
        queue.close()


def test_what_servers_refuse_and_what_sentinels_refuse_is_told_apart_with_its_remedy(replicated: Replicated) -> None:
    for port in replicated.sentinels:
        with replicated.sentinel(port) as sentinel:
            sentinel.execute_command("ACL", "SETUSER", "mute", "on", f">{ASKING}", "-@all", "+ping")
    servers_refuse = [replicated.url(user="intrasplat:wrong"), replicated.url(user=f"nobody:{PASSWORD}")]
    for told in map(refusal, servers_refuse):
        assert told.problem == "The queue refuses this user or password."
        assert "before the @ of REDIS_URL" in told.remedy
        assert not told.may_return
    without = replicated.url().partition("&sentinel_username")[0]
    sentinels_refuse = [replicated.url(by="wrong"), replicated.url(asks="nobody"), replicated.url(asks="mute"), without]
    for told in map(refusal, sentinels_refuse):
        assert told.problem == "The queue's Sentinels refuse this user or password."
        assert "sentinel_password= behind the ? of REDIS_URL" in told.remedy
        assert not told.may_return
    told = refusal(replicated.url().replace(f"/{NAME}?", "/another?"))
    assert told.problem == "No Sentinel names the queue's server."
    assert "the name that stands last in REDIS_URL" in told.remedy
    assert told.may_return


def test_two_sentinels_are_asked_when_the_first_refuses_and_not_blamed_for_a_primary_that_is_away(
    replicated: Replicated,
) -> None:
    with replicated.sentinel(replicated.sentinels[0]) as sentinel:
        sentinel.execute_command("ACL", "SETUSER", "intrasplat", "resetpass", ">another")
    queue = RedisQueue(replicated.url())
    queue.ping()
    queue.close()
    for server in replicated.servers.values():
        server.kill()
    assert refusal(replicated.url()).may_return


def test_keda_may_ask_a_sentinel_for_the_primary_and_change_nothing(replicated: Replicated) -> None:
    with replicated.sentinel(replicated.sentinels[0], "intrasplat", ASKING) as keda:
        assert keda.execute_command("SENTINEL", "GET-MASTER-ADDR-BY-NAME", NAME)[0] == "localhost"
        assert len(keda.execute_command("SENTINEL", "SENTINELS", NAME)) == 2
        watch = keda.pubsub()
        watch.subscribe("+switch-master")
        watch.close()
        for forbidden in (("FAILOVER", NAME), ("SET", NAME, "auth-pass", "x"), ("RESET", "*")):
            with pytest.raises(redis.exceptions.NoPermissionError):
                keda.execute_command("SENTINEL", *forbidden)


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
