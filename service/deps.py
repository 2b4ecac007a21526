"""What routes work with, handed to them by the application."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from contract.queue import Queue
from contract.settings import Settings
from contract.store import Store
from service.renderer import Renderer


@dataclass(frozen=True)
class Deps:
    """The four things the service is made of."""

    settings: Settings
    queue: Queue
    store: Store
    renderer: Renderer


def _deps_of(request: Request) -> Deps:
    deps = request.app.state.deps
    assert isinstance(deps, Deps)
    return deps


Services = Annotated[Deps, Depends(_deps_of)]
