"""The page for whoever runs a service says what the code does."""

from __future__ import annotations

import re

from contract.queue import redis_queue as queue_redis
from contract.queue.interface import LEASE_S, MAX_ATTEMPTS
from contract.runtime.settings import ENVIRONMENT_PREFIX, Settings, default_data_dir
from contract.store.s3 import SEEN_FOR_S
from tests.test_repository import REPOSITORY
from worker.supervisor import TIDY_PERIOD_S

PAGE = (REPOSITORY / "docs" / "operations.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    """The page's one code block in that language."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    return str(found)


def shown(value: object) -> str:
    """A default as the table has it."""
    if value is None or value == ():
        return "none"
    if value == default_data_dir():
        return "`~/.local/state/intrasplat`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def test_the_table_of_settings_has_every_setting_with_its_default() -> None:
    rows = re.findall(r"^\| `((?:INTRASPLAT|REDIS)_\w+)` \| (.*?) \|", PAGE, re.MULTILINE)
    defaults = {ENVIRONMENT_PREFIX + name.upper(): shown(value) for name, value in Settings()}
    defaults["REDIS_URL"] = defaults.pop("INTRASPLAT_REDIS_URL")
    assert dict(rows) == defaults
    assert len(rows) == len(defaults)


def test_every_variable_that_is_named_exists() -> None:
    named = set(re.findall(r"INTRASPLAT_[A-Z_]+", PAGE)) - {ENVIRONMENT_PREFIX + name.upper() for name, _ in Settings()}
    folders = (REPOSITORY / "intrasplat", REPOSITORY / "worker")
    sources = [path.read_text(encoding="utf-8") for folder in folders for path in folder.rglob("*.py")]
    assert [name for name in sorted(named) if not any(f'"{name}"' in each for each in sources)] == []


def test_nginx_hands_on_the_port_and_needs_no_new_release() -> None:
    server = block("nginx")
    assert "proxy_set_header Host $http_host;" in server  # a browser's WebSocket names its port as its origin
    assert "listen 443 ssl http2;" in server  # `http2 on` exists from 1.25.1 on


def test_the_access_list_is_that_of_the_containers() -> None:
    made = (REPOSITORY / "docker" / "make-secrets.sh").read_text(encoding="utf-8")
    (rights,) = re.findall(r"user intrasplat on #\S+ (.*?)\"?$", made, re.MULTILINE)
    assert rights in PAGE
    assert rights in (queue_redis.__doc__ or "")


def test_the_figures_are_those_of_the_code() -> None:
    assert f"after {LEASE_S:g} s of silence" in PAGE
    assert f"up to {MAX_ATTEMPTS} times" in PAGE
    assert f"nowhere after {SEEN_FOR_S:g} s" in " ".join(PAGE.split())
    assert f"within {TIDY_PERIOD_S / 60:g} minutes" in PAGE


def test_every_metric_that_is_named_exists() -> None:
    files = ("metrics.py", "feed_metrics.py")
    source = "".join((REPOSITORY / "service" / name).read_text(encoding="utf-8") for name in files)
    named = {name.removesuffix("_total") for name in re.findall(r"intrasplat_[a-z_]+", PAGE)}
    assert [name for name in sorted(named) if f'"{name}"' not in source] == []


def test_every_area_of_the_store_is_said_to_be_copied_or_not() -> None:
    areas = re.findall(r"[├└]── (\w+)/", (REPOSITORY / "contract" / "store" / "store.py").read_text(encoding="utf-8"))
    assert [area for area in areas if f"`{area}/`" not in PAGE] == []
