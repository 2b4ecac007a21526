"""`make images-check` asks podman for all that compose.yml asks of Docker, and uses the proxies that the page tells.

The check itself builds images and needs root, so it is run by hand (docker/README.md).
"""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.test_docker import DOCKER, SERVICES


@pytest.fixture
def composition(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(DOCKER / "check"))
    return importlib.import_module("composition")


@pytest.fixture
def proxies(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(DOCKER / "check"))
    return importlib.import_module("proxies")


def test_without_its_programs_it_says_that_nothing_was_checked(tmp_path: Path) -> None:
    command = [sys.executable, DOCKER / "check"]
    answer = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout == "images-check: NOTHING WAS CHECKED, for this machine has no buildah, podman, openssl\n"


@pytest.mark.parametrize("name", SERVICES)
def test_podman_is_asked_for_every_confinement_of_the_file(name: str, composition: ModuleType) -> None:
    options = composition.options(SERVICES[name])
    wanted = {"--read-only", "--read-only-tmpfs=false", "--cap-drop=ALL", "--security-opt=no-new-privileges", "--init"}
    assert wanted <= set(options)
    assert f"--memory={SERVICES[name]['mem_limit']}" in options
    assert f"--stop-timeout={SERVICES[name]['stop_grace_period'].removesuffix('s')}" in options
    assert all(f"--secret=intrasplat-check-{each},target={each}" in options for each in SERVICES[name]["secrets"])


def test_what_is_not_translated_is_told(composition: ModuleType) -> None:
    with pytest.raises(ValueError, match="privileged"):
        composition.options({**SERVICES["worker"], "privileged": True})


def test_variables_of_the_file_are_replaced_or_have_their_defaults(composition: ModuleType) -> None:
    text = (DOCKER / "compose.yml").read_text(encoding="utf-8")
    environments = [
        composition.composed(text, variables)["services"]["service"]["environment"]
        for variables in ({}, {"INTRASPLAT_HOSTS": "splat.example.org", "FORWARDED_ALLOW_IPS": "10.1.0.1"})
    ]
    assert [each["INTRASPLAT_HOSTS"] or "" for each in environments] == ["", "splat.example.org"]
    assert [each["FORWARDED_ALLOW_IPS"] for each in environments] == ["127.0.0.1", "10.1.0.1"]


def test_the_proxies_are_those_of_the_page_at_another_place(proxies: ModuleType, tmp_path: Path) -> None:
    site = proxies.Site("here", "127.0.0.2", 8443, tmp_path)
    for config in (proxies.nginx_config(site), proxies.caddy_config(site)):
        assert "127.0.0.1:8765" in config
        assert "example.org" not in config
        assert f"{tmp_path}/cert.pem" in config
    assert "listen 127.0.0.2:8443 ssl" in proxies.nginx_config(site)
    assert "https://here:8443 {\n  bind 127.0.0.2" in proxies.caddy_config(site)


@pytest.mark.parametrize("program", ["nginx", "caddy"])
def test_the_proxies_of_the_page_start_and_speak_http_2(program: str, proxies: ModuleType, tmp_path: Path) -> None:
    for each in (program, "openssl"):
        if shutil.which(each) is None:
            pytest.skip(f"{each} is not here")
    site = proxies.site_in(tmp_path)
    with proxies.proxy(program, site):
        assert proxies.protocol(site) == "h2"
