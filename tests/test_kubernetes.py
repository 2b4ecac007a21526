"""The documents for a cluster are sound, keep to the containers' rules, and scale by figures that count jobs."""

from __future__ import annotations

import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any, get_args

import kubernetes_validate  # type: ignore[import-untyped]
import pytest
import redis
import yaml  # type: ignore[import-untyped]

from contract.queue.interface import Claim
from contract.queue.redis_queue import RedisQueue
from contract.runtime.settings import ENVIRONMENT_PREFIX, OTHER_VARIABLES, Settings
from contract.store.shelf import new_job_id
from contract.wire.job import JobFiles, JobRecord, JobState
from intrasplat.errors import InputError
from intrasplat.options import JobOptions, Priority
from tests.contract.conftest import emptied, valkey_url
from tests.test_docker import SERVICES, project
from tests.test_repository import REPOSITORY

__all__ = ["valkey_url"]

FOLDER = REPOSITORY / "docker" / "kubernetes"
README = (FOLDER / "README.md").read_text(encoding="utf-8")
SENTINEL_CONF = (REPOSITORY / "docker" / "sentinel.conf").read_text(encoding="utf-8")
PARTS = frozenset({"kustomization.yaml", "patch.yaml"})
"""What kustomize reads; no documents of a cluster."""
WITHOUT_SCHEMA = frozenset({"keda.sh/v1alpha1"})
BINARY = {"m": 2**20, "g": 2**30, "Mi": 2**20, "Gi": 2**30}
Document = dict[str, Any]

needs_kubectl = pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not here")


def documents_of(text: str) -> list[Document]:
    return [each for each in yaml.safe_load_all(text) if each]


def of_kind(documents: list[Document], *kinds: str) -> dict[str, Document]:
    return {each["metadata"]["name"]: each for each in documents if each["kind"] in kinds}


FILES = sorted(path for path in FOLDER.rglob("*.yaml") if path.name not in PARTS)
DOCUMENTS = [each for path in FILES for each in documents_of(path.read_text(encoding="utf-8"))]
WORKLOADS = of_kind(DOCUMENTS, "Deployment", "StatefulSet")
COMPOSED = {"intrasplat-service": "service", "intrasplat-worker": "worker"}
"""By workload: the same container in docker/compose.yml."""

each_workload = pytest.mark.parametrize("name", WORKLOADS)


def pod_of(workload: Document) -> Document:
    return dict(workload["spec"]["template"]["spec"])


def containers_of(workload: Document) -> list[Document]:
    pod = pod_of(workload)
    return [*pod.get("initContainers", []), *pod["containers"]]


def bytes_of(quantity: str) -> int:
    number, unit = re.fullmatch(r"(\d+)([A-Za-z]+)", quantity).groups()  # type: ignore[union-attr]
    return int(number) * BINARY[unit]


def check(document: Document) -> None:
    """Return if Kubernetes' schema takes the document, with no name that it does not know."""
    if document["apiVersion"] not in WITHOUT_SCHEMA:
        kubernetes_validate.validate(document, kubernetes_validate.latest_version(), strict=True)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_document_fits_the_schema_of_its_kind(path: Path) -> None:
    for document in documents_of(path.read_text(encoding="utf-8")):
        check(document)


def test_a_document_with_a_misspelt_name_would_be_found() -> None:
    with pytest.raises(kubernetes_validate.ValidationError):
        check({**WORKLOADS["intrasplat-worker"], "spek": {}})


def joined(folder: Path, left_out: tuple[str, ...] = (), added: tuple[str, ...] = ()) -> list[Document]:
    """What kustomize makes of kustomization.yaml without some of its parts and with further components."""
    shutil.copytree(FOLDER, folder / "kubernetes")
    mine = folder / "kubernetes" / "kustomization.yaml"
    content = yaml.safe_load(mine.read_text(encoding="utf-8"))
    for key in ("resources", "components"):
        content[key] = [each for each in content[key] if each not in left_out]
    content["components"] += added
    mine.write_text(yaml.safe_dump(content), encoding="utf-8")
    command = ["kubectl", "kustomize", str(mine.parent)]
    made = documents_of(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)
    for document in made:
        check(document)
    return made


@needs_kubectl
@pytest.mark.parametrize("left_out", [(), ("gpu",), ("keda",), ("gpu", "keda")], ids=str)
def test_kustomize_joins_the_parts_to_sound_documents(left_out: tuple[str, ...], tmp_path: Path) -> None:
    made = joined(tmp_path, left_out)
    assert {each["metadata"]["namespace"] for each in made} == {"intrasplat"}
    workloads = of_kind(made, "Deployment", "StatefulSet")
    gpu = set() if "gpu" in left_out else {"intrasplat-worker-gpu"}
    assert set(workloads) == {"intrasplat-service", "intrasplat-worker"} | gpu
    (config,) = (each for each in made if each["kind"] == "ConfigMap")
    for each in workloads.values():
        assert pod_of(each)["containers"][0]["envFrom"][0]["configMapRef"]["name"] == config["metadata"]["name"]
        assert pod_of(each)["containers"][0]["image"].startswith("registry.example.org/")
    selectors = [each["spec"]["selector"]["matchLabels"] for each in workloads.values()]
    for each in workloads.values():  # no pod belongs to two of them
        labels = each["spec"]["template"]["metadata"]["labels"].items()
        assert sum(selector.items() <= labels for selector in selectors) == 1
    (ingress,) = (each for each in made if each["kind"] == "Ingress")
    assert {rule["host"] for rule in ingress["spec"]["rules"]} == {config["data"]["INTRASPLAT_HOSTS"]}
    assert {host for each in ingress["spec"]["tls"] for host in each["hosts"]} == {config["data"]["INTRASPLAT_HOSTS"]}


@needs_kubectl
@pytest.mark.parametrize("left_out", [(), ("keda",)], ids=str)
def test_behind_sentinels_keda_asks_them_as_their_user_and_their_port_is_open(
    left_out: tuple[str, ...], tmp_path: Path
) -> None:
    made = joined(tmp_path, left_out, ("sentinels",))
    for policy in of_kind(made, "NetworkPolicy").values():
        assert {6379, 26379} <= {each["port"] for each in policy["spec"]["egress"][-1]["ports"]}
    if left_out:
        return
    (scaled,) = of_kind(made, "ScaledObject").values()
    for trigger in scaled["spec"]["triggers"]:
        assert trigger["type"] == "redis-sentinel"
        assert re.search(rf"^sentinel monitor {trigger['metadata']['sentinelMaster']} ", SENTINEL_CONF, re.MULTILINE)
    (login,) = of_kind(made, "TriggerAuthentication").values()
    told = {each["parameter"]: each["key"] for each in login["spec"]["secretTargetRef"]}
    assert told.keys() == {"addresses", "username", "password", "sentinelUsername", "sentinelPassword"}
    assert all(f"--from-literal={key}=" in README for key in told.values())


@needs_kubectl
@pytest.mark.parametrize("left_out", [(), ("gpu", "keda")], ids=str)
def test_while_a_backup_is_restored_one_pod_waits_with_the_services_settings_and_no_worker_runs(
    left_out: tuple[str, ...], tmp_path: Path
) -> None:
    made = joined(tmp_path, left_out, ("restore",))
    assert {each["spec"]["replicas"] for each in of_kind(made, "Deployment").values()} == {0}
    (waiting,) = of_kind(made, "StatefulSet").values()
    pod, usual = pod_of(waiting), pod_of(WORKLOADS["intrasplat-service"])
    assert waiting["spec"]["replicas"] == 1
    assert "initContainers" not in pod  # it would put a file into the volume, which must be empty
    ((container,), (service,)) = (pod["containers"], usual["containers"])
    assert container["command"] == ["sleep", "infinity"]
    assert not [name for name in container if name.endswith("Probe")]
    for same in ("env", "volumeMounts", "securityContext"):
        assert container[same] == service[same]
    for scaled in of_kind(made, "ScaledObject").values():
        assert scaled["metadata"]["annotations"] == {"autoscaling.keda.sh/paused-replicas": "0"}


@each_workload
def test_a_pod_can_change_nothing_but_its_volumes_and_gain_no_rights(name: str) -> None:
    pod = pod_of(WORKLOADS[name])
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["runAsUser"] == pod["securityContext"]["fsGroup"] == 10001
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert pod["automountServiceAccountToken"] is False
    assert not {"hostNetwork", "hostPID", "hostIPC"} & pod.keys()
    assert not any("hostPath" in volume for volume in pod["volumes"])
    for container in containers_of(WORKLOADS[name]):
        rights = container["securityContext"]
        assert rights["readOnlyRootFilesystem"] is True
        assert rights["allowPrivilegeEscalation"] is False
        assert rights["capabilities"] == {"drop": ["ALL"]}


@each_workload
def test_a_pod_has_the_limits_the_time_to_end_and_the_image_of_the_container_in_compose(name: str) -> None:
    composed, pod = SERVICES[COMPOSED[name]], pod_of(WORKLOADS[name])
    (container,) = pod["containers"]
    assert bytes_of(container["resources"]["limits"]["memory"]) == bytes_of(composed["mem_limit"])
    assert f"{pod['terminationGracePeriodSeconds']}s" == composed["stop_grace_period"]
    assert container["image"] == composed["image"]
    assert {"cpu", "memory"} <= container["resources"]["requests"].keys()


def test_the_image_of_gpu_workers_is_that_of_compose() -> None:
    patch = yaml.safe_load((FOLDER / "gpu" / "patch.yaml").read_text(encoding="utf-8"))
    composed = yaml.safe_load((FOLDER.parent / "compose.gpu.yml").read_text(encoding="utf-8"))
    assert pod_of(patch)["containers"][0]["image"] == composed["services"]["worker"]["image"]


def variables() -> set[str]:
    """Every variable that the documents set."""
    found = set()
    for path in FOLDER.rglob("*.yaml"):
        for document in documents_of(path.read_text(encoding="utf-8")):
            for made in document.get("configMapGenerator", []) if isinstance(document, dict) else []:
                found |= {literal.partition("=")[0] for literal in made["literals"]}
            if document["kind"] in ("Deployment", "StatefulSet"):
                found |= {each["name"] for one in containers_of(document) for each in one.get("env", [])}
    return found


def test_every_variable_that_is_set_is_a_setting() -> None:
    names = {name.upper() for name in Settings.model_fields} | OTHER_VARIABLES
    known = {f"{ENVIRONMENT_PREFIX}{name}" for name in names} | {"REDIS_URL", "FORWARDED_ALLOW_IPS", "POD_IP"}
    foreign = {each for each in variables() if each.removesuffix("_FILE") not in known}
    assert foreign == {"AWS_DEFAULT_REGION", "AWS_ENDPOINT_URL"}


def test_what_the_cluster_would_set_of_its_own_is_kept_away() -> None:
    with pytest.raises(InputError, match="INTRASPLAT_PORT"):  # what a Service named `intrasplat` gives its pods
        Settings.from_environment({"INTRASPLAT_PORT": "tcp://10.0.0.7:8765"})
    assert all(pod_of(each)["enableServiceLinks"] is False for each in WORKLOADS.values())


def test_the_name_of_a_pod_is_a_name_of_a_worker() -> None:
    for deployment in ("intrasplat-worker", "intrasplat-worker-gpu"):
        Settings(worker_name=f"{deployment}-6b79d4f8c5-x2x4z")


def test_probes_ask_the_service_at_its_port_by_a_name_that_it_answers_to() -> None:
    service = pod_of(WORKLOADS["intrasplat-service"])["containers"][0]
    (port,) = service["ports"]
    assert port["containerPort"] == Settings().port
    for kind in ("startupProbe", "livenessProbe", "readinessProbe"):
        asked = service[kind]["httpGet"]
        assert (asked["path"], asked["port"]) == ("/healthz", port["name"])
        assert asked["httpHeaders"] == [{"name": "Host", "value": "localhost"}]
    worker = pod_of(WORKLOADS["intrasplat-worker"])["containers"][0]
    assert worker["readinessProbe"]["exec"]["command"] == ["python", "/app/health.py", "worker"]
    assert "livenessProbe" not in worker  # it would end trainings while the queue is away


def test_every_secret_that_is_read_is_one_that_the_page_makes() -> None:
    text = "\n".join(path.read_text(encoding="utf-8") for path in FILES)
    named = set(re.findall(r"secretName: ([\w-]+)|secretRef: \{name: ([\w-]+)\}|name: (intrasplat-scaler)", text))
    made = set(re.findall(r"create secret \w+ ([\w-]+)", README))
    assert {name for each in named for name in each if name} == made
    for key in ("redis_url", "render_secret", "webhook_secret"):
        assert f"/run/secrets/intrasplat/{key}" in text + README
        assert f"--from-literal={key}=" in README


# KEDA's scaler "redis" counts a key by its kind, as this does in fewer words.
COUNT = """
local count = ({zset = 'zcard', hash = 'hlen', none = 'llen'})[redis.call('type', KEYS[1]).ok]
return redis.call(count, KEYS[1])
"""
(SCALED,) = (each["spec"] for each in DOCUMENTS if each["kind"] == "ScaledObject")


def workers_wanted(reader: redis.Redis) -> int:
    """What KEDA would ask for, before the least and the most."""
    figures = {each["name"]: reader.eval(COUNT, 1, each["metadata"]["listName"]) for each in SCALED["triggers"]}
    formula = SCALED["advanced"]["scalingModifiers"]["formula"]
    assert re.fullmatch(r"\w+( \+ \w+)*", formula)
    return sum(int(figures[name]) for name in formula.split(" + "))


@pytest.fixture
def reader(valkey_url: str) -> redis.Redis:
    """A connection as the user that README.md gives KEDA."""
    (rights,) = re.findall(r"^ *user keda on #SHA256_OF_PASSWORD (.*)$", README, re.MULTILINE)
    admin = redis.Redis.from_url(emptied(valkey_url))
    admin.execute_command("ACL", "SETUSER", "keda", "reset", "on", ">secret", *rights.split())
    kind = {"username": "keda", "password": "secret"}
    return redis.Redis(connection_pool=redis.ConnectionPool.from_url(valkey_url, **kind))


def test_keda_wants_a_worker_for_each_job_that_waits_or_runs(valkey_url: str, reader: redis.Redis) -> None:
    queue = RedisQueue(valkey_url)
    assert workers_wanted(reader) == 0
    for priority in (*get_args(Priority), "standard"):
        options = JobOptions(priority=priority)
        files, now_s = JobFiles(clip="clip.mp4"), time.time()
        queue.submit(JobRecord(job_id=new_job_id(), files=files, options=options, created_at_s=now_s))
    assert workers_wanted(reader) == 3
    claims = []
    for worker in ("worker-1", "worker-2"):  # a claim reads all entries of a stream: its pending ones are no figure
        record = queue.claim(worker, 1.0)
        assert record is not None
        claims.append(Claim(record.job_id, record.attempt, worker))
        assert workers_wanted(reader) == 3
    assert queue.finish(claims[0])
    assert workers_wanted(reader) == 2
    assert queue.release(claims[1])
    assert workers_wanted(reader) == 2
    for record in queue.records():
        if record.state is JobState.QUEUED:
            queue.cancel(record.job_id)
    assert workers_wanted(reader) == 0
    queue.close()


def test_keda_ends_no_worker_that_trains_because_fewer_jobs_wait(valkey_url: str, reader: redis.Redis) -> None:
    queue = RedisQueue(valkey_url)
    for _ in range(4):
        queue.submit(JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=time.time()))
    for number in range(4):
        assert queue.claim(f"worker-{number}", 1.0) is not None
        assert workers_wanted(reader) == 4
    queue.close()


def test_the_user_of_keda_can_count_and_nothing_else(valkey_url: str, reader: redis.Redis) -> None:
    for command in (["ZRANGE", "{intrasplat}:queued", "0", "-1"], ["DEL", "{intrasplat}:held"], ["INFO"]):
        with pytest.raises(redis.exceptions.NoPermissionError):
            reader.execute_command(*command)
    with pytest.raises(redis.exceptions.ResponseError, match=r"(?i)permission"):
        reader.eval("return redis.call('hlen', KEYS[1])", 1, "{intrasplat}:job:x")


def test_keda_never_counts_what_a_group_has_pending() -> None:
    for trigger in SCALED["triggers"]:
        assert trigger["type"] == "redis"
        assert "consumerGroup" not in trigger["metadata"]
    assert SCALED["scaleTargetRef"]["name"] in WORKLOADS
    assert SCALED["advanced"]["scalingModifiers"]["target"] == "1"


def test_tags_of_images_are_this_version() -> None:
    images = re.findall(r"image: \S+:([\w.-]+)", "\n".join(path.read_text() for path in FOLDER.rglob("*.yaml")))
    images += re.findall(r"intrasplat-(?:\$name|service|worker):([\w.-]+)", README)
    assert {tag.removesuffix("-gpu") for tag in images} == {project()["version"]}
