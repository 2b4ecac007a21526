"""The running service that the tests here ask for by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver

from contract.queue.interface import Claim
from intrasplat_client import Client
from tests.client.local_service import CLIP, LocalService, local_service
from tests.client.page import Page, Site, browser, site_at


@pytest.fixture(scope="package")
def _service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalService]:
    with local_service(tmp_path_factory.mktemp("data")) as service:
        yield service


@pytest.fixture
def service(_service: LocalService) -> LocalService:
    """The service, with nothing to do and its worker awake."""
    for record in _service.queue.records():
        _service.queue.cancel(record.job_id)
        _service.queue.confirm_cancel(Claim(record.job_id, record.attempt, record.owner or ""))
    _service.announce()
    return _service


@pytest.fixture
def client(service: LocalService) -> Iterator[Client]:
    with Client(service.url) as client:
        yield client


@pytest.fixture
def clip() -> Path:
    return CLIP


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with browser() as driver:
        yield driver


@pytest.fixture
def site(tmp_path: Path, driver: webdriver.Chrome) -> Iterator[Site]:
    with site_at(tmp_path / "data") as site:
        yield site


@pytest.fixture
def page(site: Site, driver: webdriver.Chrome) -> Iterator[Page]:
    page = Page(driver, site.url)
    page.open()
    yield page
    assert page.faults() == []
    driver.get("about:blank")  # or its connections keep the service from ending
