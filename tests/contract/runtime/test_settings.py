"""Settings come from the environment, secrets from files, and children read what their parent did."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.runtime.settings import Settings
from intrasplat.errors import InputError


def test_settings_are_read_from_their_variables_and_empty_ones_count_as_unset(tmp_path: Path) -> None:
    read = Settings.from_environment(
        {"INTRASPLAT_DATA_DIR": str(tmp_path), "INTRASPLAT_PORT": "", "INTRASPLAT_HOSTS": "a.example, b.example"}
    )
    assert read == Settings(data_dir=tmp_path, hosts=("a.example", "b.example"))


def test_a_secret_can_be_given_as_a_file(tmp_path: Path) -> None:
    (tmp_path / "url").write_text("redis://user:word@queue:6379/0\n")
    (tmp_path / "secret").write_text("s" * 40 + "\n")
    read = Settings.from_environment(
        {"REDIS_URL_FILE": str(tmp_path / "url"), "INTRASPLAT_RENDER_SECRET_FILE": str(tmp_path / "secret")}
    )
    assert read.redis_url == "redis://user:word@queue:6379/0"
    assert read.render_secret == "s" * 40


def test_a_variable_goes_before_its_file(tmp_path: Path) -> None:
    read = Settings.from_environment({"REDIS_URL": "redis://here", "REDIS_URL_FILE": str(tmp_path / "absent")})
    assert read.redis_url == "redis://here"


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="REDIS_URL_FILE"):
        Settings.from_environment({"REDIS_URL_FILE": str(tmp_path / "absent")})


@pytest.mark.parametrize(("variable", "value"), [("INTRASPLAT_PORT", "no"), ("INTRASPLAT_STORE_URL", "ftp://x")])
def test_a_value_that_is_not_accepted_is_named_with_its_variable(variable: str, value: str) -> None:
    with pytest.raises(InputError, match=variable):
        Settings.from_environment({variable: value})


SECRETS = [name for name in Settings.model_fields if name == "redis_url" or name.endswith("_secret")]


@pytest.mark.parametrize("name", [name for name in SECRETS if name != "redis_url"])
def test_a_secret_that_is_not_accepted_is_named_and_not_shown(name: str, tmp_path: Path) -> None:
    variable = f"INTRASPLAT_{name.upper()}"
    (tmp_path / "secret").write_text("too short to tell\n")
    for given in ({variable: "too short to tell"}, {f"{variable}_FILE": str(tmp_path / "secret")}):
        with pytest.raises(InputError, match=variable) as refused:
            Settings.from_environment(given)
        assert "at least 32 characters" in str(refused.value)
        assert "too short to tell" not in f"{refused.value} {refused.value.__cause__}"


def test_the_text_of_settings_shows_no_secret() -> None:
    text = repr(Settings(**dict.fromkeys(SECRETS, "to be kept to those who may know it")))
    assert "to be kept" not in text
    assert "worker-1" in text


def test_a_child_process_reads_the_settings_of_its_parent(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, redis_url="redis://here", hosts=("a.example",), retention_hours=2.5)
    assert Settings.from_environment(settings.to_environment()) == settings


@pytest.mark.parametrize(
    ("variable", "meant"),
    [("INTRASPLAT_HSOTS", "INTRASPLAT_HOSTS"), ("INTRASPLAT_DATADIR", "INTRASPLAT_DATA_DIR")],
)
def test_a_misspelt_variable_is_refused_with_the_setting_that_is_meant(variable: str, meant: str) -> None:
    with pytest.raises(InputError, match=variable) as refused:
        Settings.from_environment({variable: "a.example"})
    assert refused.value.remedy == f"Did you mean {meant}? Else unset it."


def test_variables_of_commands_and_those_that_kubernetes_adds_are_no_settings() -> None:
    others = ("URL", "API_KEY", "DATA", "CACHE", "THREADS", "SERVICE_HOST", "SERVICE_PORT", "PORT_8765_TCP_ADDR")
    read = Settings.from_environment({f"INTRASPLAT_{name}": "x" for name in others} | {"INTRASPLAT_HSOTS": ""})
    assert read == Settings()
