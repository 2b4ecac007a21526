"""A disk that is full, read-only or gone is said to be so, and harms nothing that was stored before."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from contract.store.shelf import new_job_id
from contract.store.store import Store
from intrasplat.errors import UnavailableError
from intrasplat.files.disk_errors import StoreFullError, disk_errors
from intrasplat.names import MANIFEST, SUBMISSION
from tests.contract.stores import files_no_larger_than, received

NOBODY = 65534
SMALL_BYTES = 64
"""Less than any submission has."""


@pytest.fixture
def read_only_store() -> Iterator[Store]:
    """A store whose folders this process may read, and not write to; root becomes nobody for so long."""
    base = Path(tempfile.mkdtemp(prefix="intrasplat-test-"))
    base.chmod(0o755)
    store = Store(base / "data")
    (store.work_folder("a" * 32, 1) / MANIFEST).write_text("{}")
    store.publish_scene("a" * 32, 1)
    for folder in (store.data_dir, *store.data_dir.rglob("*")):
        folder.chmod(0o555)
    user_id = os.geteuid()
    if user_id == 0:
        os.seteuid(NOBODY)
    try:
        yield store
    finally:
        os.seteuid(user_id)
        for folder in (store.data_dir, *(path for path in store.data_dir.rglob("*") if path.is_dir())):
            folder.chmod(0o755)
        shutil.rmtree(base)


def test_a_clip_that_a_full_disk_cannot_accept_is_refused_and_can_be_discarded(tmp_path: Path) -> None:
    store = Store(tmp_path)
    earlier = received(store)
    store.accept(earlier)
    record = received(store)
    (store.incoming_folder(record.job_id) / SUBMISSION).symlink_to("/dev/full")  # every write to it: no space left
    with pytest.raises(StoreFullError, match="no room left") as raised:
        store.accept(record)
    assert str(tmp_path) not in str(raised.value)
    assert store.spooled_ids() == [earlier.job_id]
    assert (store.incoming_folder(record.job_id) / "clip.mp4").read_bytes() == b"frames"
    store.discard_incoming(record.job_id)
    assert list((tmp_path / "incoming").iterdir()) == []


def test_a_clip_beyond_the_quota_is_refused_and_accepted_once_there_is_room(tmp_path: Path) -> None:
    store = Store(tmp_path)
    record = received(store)
    with files_no_larger_than(SMALL_BYTES), pytest.raises(StoreFullError, match="File too large"):
        store.accept(record)
    assert store.spooled_ids() == []
    store.accept(record)
    assert store.submission(record.job_id) == record


def test_a_read_only_store_still_shows_its_scenes(read_only_store: Store) -> None:
    assert (read_only_store.scene_folder("a" * 32, 1) / MANIFEST).read_text() == "{}"
    assert read_only_store.published_attempt("a" * 32) == 1


@pytest.mark.parametrize(
    "write",
    [
        lambda store: store.open_incoming(new_job_id()),
        lambda store: store.work_folder(new_job_id(), 1),
        lambda store: store.scratch_folder("worker-1"),
        lambda store: store.purge("a" * 32),
        lambda store: store.remove_attempt("a" * 32, 1),
    ],
    ids=["open_incoming", "work_folder", "scratch_folder", "purge", "remove_attempt"],
)
def test_what_cannot_be_written_is_said_to_be_so(read_only_store: Store, write: Callable[[Store], object]) -> None:
    with pytest.raises(UnavailableError, match="cannot be written to"):
        write(read_only_store)
    assert read_only_store.has_scene("a" * 32, 1)


def test_a_data_directory_that_is_gone_is_said_to_be_gone(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    shutil.rmtree(store.data_dir)
    for method in (store.spooled_ids, store.free_bytes, lambda: store.open_incoming(new_job_id())):
        with pytest.raises(UnavailableError, match="is gone"):
            method()


def test_a_data_directory_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UnavailableError, match="Not a directory"):
        Store(tmp_path / "file" / "data")


def test_other_faults_of_a_disk_are_told_with_their_reason() -> None:
    with pytest.raises(UnavailableError, match="Bad file descriptor"), disk_errors():
        os.fsync(10**6)
