"""Clients generated from /openapi.json send a clip to a real service, wait for its scene, and save a picture."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx
import pytest

from tests.client.local_service import CLIP, LocalService, local_service
from tests.reports import REPORT_OF_A_SCENE

REPOSITORY = Path(__file__).resolve().parents[2]
CONFIG = REPOSITORY / "docs" / "openapi-python-client.yaml"
GENERATED = Path(__file__).resolve().parent / "generated"
INSTALL_S = 300.0
MADE_S = 120.0


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalService]:
    with local_service(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture(scope="module")
def document(service: LocalService, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("api") / "openapi.json"
    path.write_bytes(httpx.get(f"{service.url}/openapi.json").content)
    return path


@contextmanager
def working(service: LocalService) -> Iterator[None]:
    """A worker that finishes the next job."""
    worker = threading.Thread(target=service.finish)
    worker.start()
    try:
        yield
    finally:
        worker.join()


@pytest.fixture(scope="module")
def python_client(document: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    folder = tmp_path_factory.mktemp("python")
    name = "generated_intrasplat"
    command = [sys.executable, "-m", "openapi_python_client", "generate", "--path", str(document), "--meta", "none"]
    command += ["--config", str(CONFIG), "--output-path", str(folder / name), "--fail-on-warning"]
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # the generator asks ruff to format
    environment = {**os.environ, "PATH": path}
    made = subprocess.run(command, capture_output=True, text=True, timeout=MADE_S, check=False, env=environment)
    assert made.returncode == 0, made.stdout + made.stderr
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield importlib.import_module(name)


def operation(client: ModuleType, path: str) -> Any:
    return importlib.import_module(f"{client.__name__}.api.{path}")


def test_a_generated_python_client_sends_a_clip_waits_and_saves_a_picture(
    service: LocalService, python_client: ModuleType
) -> None:
    models, types = (importlib.import_module(f"{python_client.__name__}.{name}") for name in ("models", "types"))
    with python_client.Client(service.url) as client, working(service), CLIP.open("rb") as clip:
        form = models.ClipForm(
            clip=types.File(clip, "a.mp4", "video/mp4"),
            label="from Python",
            metadata=models.ClipFormMetadata.from_dict({"ris": "17"}),
            options=models.JobOptions(budget_s=20.0),
        )
        job = operation(python_client, "jobs.reconstruct").sync(client=client, body=form)
        assert (job.label, job.metadata.to_dict(), job.options.budget_s) == ("from Python", {"ris": "17"}, 20.0)
        while job.state is not models.JobState.DONE:
            job = operation(python_client, "jobs.get_job").sync(job.id, client=client)
        report = operation(python_client, "scenes.get_scene").sync(job.id, client=client)
        assert isinstance(report, models.Report)
        assert (report.psnr_tissue_db, report.masks) == (REPORT_OF_A_SCENE.psnr_tissue_db, None)
        picture = operation(python_client, "renders.render").sync(client=client, scene=job.id, t=0.5)
        assert picture.payload.read() == httpx.get(f"{service.url}/render?t=0.5&scene={job.id}").content


def test_a_generated_python_client_sends_a_clip_in_pieces_and_labels_it(
    service: LocalService, python_client: ModuleType
) -> None:
    models, types = (importlib.import_module(f"{python_client.__name__}.{name}") for name in ("models", "types"))
    tus = {"tus_resumable": "1.0.0"}
    with python_client.Client(service.url) as client, CLIP.open("rb") as clip:
        made = operation(python_client, "uploads.create_upload").sync_detailed(
            client=client, upload_length=CLIP.stat().st_size, upload_metadata="part Y2xpcA==,suffix Lm1wNA==", **tus
        )
        upload_id = made.headers["location"].rpartition("/")[2]
        sent = operation(python_client, "uploads.append_to_upload").sync_detailed(
            upload_id, client=client, body=types.File(clip), upload_offset=0, **tus
        )
        assert sent.status_code == 204
        body = models.ClipOfUploads(clip=upload_id)
        job = operation(python_client, "jobs.reconstruct").sync(client=client, body=body)
        change = models.LabelChange(label="later")
        assert operation(python_client, "jobs.label_job").sync(job.id, client=client, body=change).label == "later"
        refused = operation(python_client, "jobs.get_job").sync("0" * 32, client=client)
        assert (refused.status, refused.field) == (404, "job_id")
        assert operation(python_client, "system.info").sync(client=client).limits["max_frames"] == 1000
        assert operation(python_client, "jobs.cancel_job").sync(job.id, client=client).state == "cancelled"


@pytest.fixture(scope="module")
def node_modules(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the generator of TypeScript and its compiler."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are not installed")
    folder = tmp_path_factory.mktemp("typescript")
    for name in ("package.json", "use.ts"):
        shutil.copy(GENERATED / name, folder)
    command = ["npm", "install", "--no-audit", "--no-fund", "--prefer-offline", "--ignore-scripts"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=INSTALL_S, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip(f"npm has not answered within {INSTALL_S:g} s")
    if done.returncode != 0:
        pytest.skip(f"npm cannot install the generator: {done.stderr[-200:]}")
    return folder


def in_node(folder: Path, *command: str) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=MADE_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_generated_typescript_client_sends_a_clip_waits_and_saves_a_picture(
    service: LocalService, document: Path, node_modules: Path
) -> None:
    programs, picture = node_modules / "node_modules" / ".bin", node_modules / "view.png"
    in_node(node_modules, f"{programs}/openapi-ts", "-i", str(document), "-o", "api", "-c", "@hey-api/client-fetch")
    strict = ["--strict", "--noUncheckedIndexedAccess", "--skipLibCheck", "--types", "node"]
    strict += ["--module", "commonjs", "--target", "es2022", "--lib", "es2022,dom,dom.iterable"]
    in_node(node_modules, f"{programs}/tsc", *strict, "--outDir", "built", "use.ts")
    with working(service):
        told = json.loads(in_node(node_modules, "node", "built/use.js", service.url, str(CLIP), str(picture)))
    assert (told["label"], told["db"]) == ("from TypeScript", 36.2)
    assert picture.read_bytes() == httpx.get(f"{service.url}/render?t=0.5&scene={told['id']}").content
