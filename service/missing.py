"""The answer where a path or its method does not exist: names those of the API that are nearest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.requests import Request

from service.problems import API_REMEDY, MAX_SHOWN, Problem, answer


def install_missing_handler(app: FastAPI) -> None:
    """Answer requests without a route; after install_handlers()."""
    app.add_exception_handler(HTTPException, _answer)


async def _answer(connection: Any, error: Any) -> Any:
    if isinstance(connection, Request) and error.status_code in (404, 405):
        return await answer(connection, _missing(connection) or error)
    return await answer(connection, error)


def _missing(request: Request) -> Problem | None:
    """405 with Allow if the path has other methods, else 404. None: it is not the API's, such as one of a file."""
    paths: Mapping[str, Mapping[str, Any]] = request.app.openapi()["paths"]
    parts = request.scope["path"].split("/")
    path, there = _nearest(paths, parts)
    if request.method in there:
        return None
    if there:
        allowed = sorted({*there, *(["HEAD"] if "GET" in there else [])})
        detail = f"{path} has no method {request.method[:MAX_SHOWN]}."
        return Problem(405, detail, remedy=_remedy(path, there), headers={"Allow": ", ".join(allowed)})
    path, above = _nearest(paths, parts[:-1])
    if not above:
        return None
    meant = {name: each for name, each in above.items() if parts[-1] in each["operationId"].split("_")}
    return Problem(404, "There is no such path.", remedy=_remedy(path, meant or above))


def _nearest(paths: Mapping[str, Mapping[str, Any]], parts: Sequence[str]) -> tuple[str, dict[str, Any]]:
    """The template of a path, and its operations by method; neither if there is none."""
    for template in sorted(paths, key=lambda each: each.count("{")):
        names = template.split("/")
        if len(names) == len(parts) and all(map(_fits, names, parts)):
            return template, {method.upper(): each for method, each in paths[template].items()}
    return "", {}


def _fits(name: str, part: str) -> bool:
    return name == part or (name.startswith("{") and part != "")


def _remedy(path: str, operations: Mapping[str, Any]) -> str:
    named = ", ".join(f"{method} {path} ({operations[method]['operationId']})" for method in sorted(operations))
    return f"There {'is' if len(operations) == 1 else 'are'} {named}. {API_REMEDY}"
