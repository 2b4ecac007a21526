"""Checks the parameters of a request's query: unknown and repeated names are refused."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from difflib import get_close_matches
from typing import Any

from starlette.requests import HTTPConnection

from service.problems import API_REMEDY, MESSAGE_REMEDY, Problem


def check_query(connection: HTTPConnection) -> None:
    """Return if the route has every parameter of the query, and none is repeated that may not be. A WebSocket has none.

    Raises:
        Problem: 422: names the first wrong parameter, and the most similar one that the route has.
    """
    given = connection.query_params.multi_items()
    if not given:
        return
    if connection.scope["type"] == "websocket":
        problem = "A WebSocket has no parameters."
        raise Problem(422, problem, field=given[0][0][:40], remedy=f"Send it in a message. {MESSAGE_REMEDY}")
    schemas = _schemas(connection)
    seen: set[str] = set()
    for name, _ in given:
        if name not in schemas:
            raise no_such_parameter(name, schemas)
        if name in seen and schemas[name].get("type") != "array":
            raise Problem(422, "The parameter comes more than once.", field=name, remedy=f"Send it once. {API_REMEDY}")
        seen.add(name)


def no_such_parameter(name: str, known: Collection[str]) -> Problem:
    """The answer to an unknown parameter: names the most similar one of those that are known, or all."""
    near = get_close_matches(name, known, 1)
    there = ", ".join(sorted(known))
    remedy = f"Did you mean {near[0]}?" if near else f"There are {there}." if there else "Leave it out."
    return Problem(422, "There is no such parameter here.", field=name[:40], remedy=remedy)


def _schemas(connection: HTTPConnection) -> Mapping[str, Mapping[str, Any]]:
    """The schemas of the route's query parameters, by name."""
    path, method = connection.scope["route"].path, connection.scope["method"].lower()
    operation = connection.app.openapi()["paths"].get(path, {}).get(method, {})
    return {each["name"]: each["schema"] for each in operation.get("parameters", ()) if each["in"] == "query"}
