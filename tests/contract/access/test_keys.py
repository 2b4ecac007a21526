"""Keys: made once, kept as hashes, refused at once when revoked, and never open by accident."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from contract.access.keys import (
    DAY_S,
    KEYS_FILE,
    ROTATED_FILE,
    WARN_BEFORE_S,
    KeyFile,
    KeyScope,
    check_keys,
)
from contract.runtime.settings import Settings
from intrasplat.errors import InputError, UnavailableError


def test_a_key_is_found_by_its_text_and_by_nothing_else(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    key, text = keys.create("ward-3", {KeyScope.VIEW}, "theatre 2")
    assert text.startswith(f"isp_{key.key_id}_")
    assert keys.find(text) == key
    wrong = (
        text[:-1],
        text + "0",
        text.upper(),
        text.replace("isp_", "xyz_"),
        f"isp_{key.key_id}_",
        f"isp_{key.key_id}_\ud800",
        "isp",
        "",
        "é" * 9,
    )
    assert [keys.find(other) for other in wrong] == [None] * len(wrong)


def test_the_file_is_the_owners_alone_and_holds_no_secret(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    _, text = keys.create("ward-3")
    path = tmp_path / KEYS_FILE
    assert path.stat().st_mode & 0o777 == 0o600
    assert text.rpartition("_")[2] not in path.read_text()
    assert text.rpartition("_")[2] not in repr(keys.list())


def test_a_revoked_key_is_refused_at_once_by_services_that_run(tmp_path: Path) -> None:
    service, command = KeyFile(tmp_path), KeyFile(tmp_path)
    first, first_text = command.create("a")
    second, second_text = command.create("b")
    assert (service.find(first_text), service.find(second_text)) == (first, second)
    assert command.revoke(first.key_id) == first
    with pytest.raises(InputError, match="no key"):
        command.revoke(first.key_id)
    assert (service.find(first_text), service.find(second_text)) == (None, second)
    assert service.list() == (second,)


@pytest.mark.parametrize(
    "content", [b"", b"{}x", b'{"version": 2, "keys": []}', b'{"keys": [{"key_id": "1"}]}', b"\xff"]
)
def test_a_damaged_file_lets_nobody_in_and_is_not_overwritten(tmp_path: Path, content: bytes) -> None:
    keys = KeyFile(tmp_path)
    _, text = keys.create("a")
    assert keys.find(text) is not None
    (tmp_path / KEYS_FILE).write_bytes(content)
    for _ in range(2):
        with pytest.raises(UnavailableError, match="no key is accepted"):
            keys.find(text)
    with pytest.raises(UnavailableError):
        keys.create("b")
    assert (tmp_path / KEYS_FILE).read_bytes() == content


def test_a_file_that_is_gone_holds_no_keys(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    _, text = keys.create("a")
    assert keys.find(text) is not None
    (tmp_path / KEYS_FILE).unlink()
    assert keys.find(text) is None
    assert keys.list() == ()


@pytest.mark.parametrize(
    ("tenant", "scopes", "label", "field"),
    [
        ("Ward 3", {KeyScope.VIEW}, None, "tenant"),
        ("", {KeyScope.VIEW}, None, "tenant"),
        ("a", set(), None, "scopes"),
        ("a", {KeyScope.VIEW}, "x" * 61, "label"),
    ],
)
def test_a_tenant_or_scope_that_is_not_accepted_is_named(
    tmp_path: Path, tenant: str, scopes: set[KeyScope], label: str | None, field: str
) -> None:
    with pytest.raises(InputError) as caught:
        KeyFile(tmp_path).create(tenant, scopes, label)
    assert caught.value.field == field


def test_a_write_that_was_cut_off_leaves_the_old_keys_and_does_not_block_new_ones(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    key, _ = keys.create("a")
    (tmp_path / f".{KEYS_FILE}.new").write_bytes(b'{"keys": [')
    assert KeyFile(tmp_path).list() == (key,)
    keys.create("b")
    assert [each.tenant for each in KeyFile(tmp_path).list()] == ["a", "b"]


def test_a_service_that_others_reach_needs_a_key(tmp_path: Path) -> None:
    check_keys(Settings(data_dir=tmp_path))
    abroad = Settings(data_dir=tmp_path, host="0.0.0.0")
    with pytest.raises(UnavailableError, match="intrasplat keys create"):
        check_keys(abroad)
    KeyFile(tmp_path).create("ward")
    check_keys(abroad)


def test_a_key_expires_at_its_time_and_old_files_are_read_and_new_ones_stay_readable(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    lasting, _ = keys.create("a")
    assert "expires_at_s" not in (tmp_path / KEYS_FILE).read_text()  # which version 0.2 would refuse
    ending, text = keys.create("b", expires_at_s=2e9)
    assert keys.find(text) == ending
    assert [key.has_expired(2e9 - 1) for key in (lasting, ending)] == [False, False]
    assert [key.has_expired(2e9) for key in (lasting, ending)] == [False, True]
    assert keys.expiring(2e9 - WARN_BEFORE_S) == (ending,)
    assert keys.expiring(2e9 - WARN_BEFORE_S - 1) == keys.expiring(2e9) == ()


def test_a_successor_is_like_the_key_before_and_lasts_as_long_which_ends_after_the_overlap(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    old, old_text = keys.create("ward-3", {KeyScope.VIEW}, "theatre 2", time.time() + 1000.0)
    new, text = keys.successor(old.key_id)
    ending = keys.rotate(old.key_id, new, time.time() + 10.0)
    assert keys.find(old_text) == ending
    assert (ending.expires_at_s or 0.0) < (old.expires_at_s or 0.0) <= (new.expires_at_s or 0.0)
    assert (new.tenant, new.scopes, new.label) == (old.tenant, old.scopes, old.label)
    assert keys.find(text) == new
    assert keys.rotate(old.key_id, keys.successor(old.key_id)[0], 3e9) == ending
    with pytest.raises(InputError, match="no key"):
        keys.rotate("000000000000", new, 3e9)


@pytest.mark.parametrize("lasts_s", [None, 90 * DAY_S])
def test_whoever_rotates_a_key_twice_gets_two_keys_that_last_as_long_as_it_was_made_to(
    tmp_path: Path, lasts_s: float | None
) -> None:
    keys = KeyFile(tmp_path)
    key, _ = keys.create("ward-3", expires_at_s=lasts_s and time.time() + lasts_s)
    for _ in range(2):
        new, _ = keys.successor(key.key_id)
        keys.rotate(key.key_id, new, time.time() + DAY_S)
        lasting_s = new.expires_at_s and new.expires_at_s - new.created_at_s
        assert lasting_s == (lasts_s and pytest.approx(lasts_s, abs=60.0))


def test_a_key_that_has_a_successor_is_not_among_those_to_be_rotated(tmp_path: Path) -> None:
    keys, soon_s = KeyFile(tmp_path), time.time() + DAY_S
    old, _ = keys.create("ward-3", expires_at_s=soon_s)
    assert keys.expiring(time.time()) == (old,)
    keys.rotate(old.key_id, keys.successor(old.key_id, soon_s + WARN_BEFORE_S)[0], soon_s)
    assert keys.expiring(time.time()) == ()


def test_the_file_of_keys_has_no_field_that_an_earlier_version_refuses(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    lasting, _ = keys.create("a", label="theatre 2")
    for key in (lasting, keys.create("b", expires_at_s=2e9)[0]):
        keys.rotate(key.key_id, keys.successor(key.key_id)[0], 1e9)
    stored = json.loads((tmp_path / KEYS_FILE).read_text())
    assert stored.keys() == {"version", "keys"}
    earlier = {"key_id", "tenant", "scopes", "secret_sha256", "created_at_s", "label", "expires_at_s"}
    assert set().union(*stored["keys"]) == earlier
    assert [key.get("expires_at_s") for key in stored["keys"][:2]] == [1e9, 1e9]  # what an earlier version goes by


def test_a_note_of_rotated_keys_that_is_lost_or_damaged_lets_no_key_last_longer(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    key, text = keys.create("ward-3")
    keys.rotate(key.key_id, keys.successor(key.key_id)[0], time.time() + DAY_S)
    assert keys.expiring(time.time()) == ()
    (tmp_path / ROTATED_FILE).write_text("{")
    assert keys.expiring(time.time()) == (keys.find(text),)
    with pytest.raises(UnavailableError, match=f"{ROTATED_FILE} cannot be read.*--expires"):
        keys.successor(key.key_id)
    (tmp_path / ROTATED_FILE).unlink()
    assert (keys.successor(key.key_id)[0].expires_at_s or 0.0) < time.time() + 2 * DAY_S


def test_a_key_whose_successor_was_revoked_is_to_be_rotated_again_and_the_next_lasts_as_it_did(tmp_path: Path) -> None:
    keys = KeyFile(tmp_path)
    key, _ = keys.create("ward-3")
    lost, _ = keys.successor(key.key_id)
    ending = keys.rotate(key.key_id, lost, time.time() + DAY_S)
    keys.revoke(lost.key_id)
    assert keys.expiring(time.time()) == (ending,)
    assert keys.successor(key.key_id)[0].expires_at_s is None
