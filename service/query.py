"""Checks the parameters of a request's query: unknown and repeated names are refused."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from starlette.requests import HTTPConnection

from service.problems import API_REMEDY, Problem


def check_query(connection: HTTPConnection) -> None:
    """Return if the route has every parameter of the query, and none is repeated that may not be.

    Raises:
        Problem: 422: names the first wrong parameter, and the most similar one that the route has.
    """
    given = connection.query_params.multi_items()
    if not given or connection.scope["type"] != "http":
        return
    schemas = _schemas(connection)
    seen: set[str] = set()
    for name, _ in given:
        if name not in schemas:
            near = get_close_matches(name, schemas, 1)
            there = ", ".join(sorted(schemas))
            remedy = f"Did you mean {near[0]}?" if near else f"There are {there}." if there else "Leave it out."
            raise Problem(422, "There is no such parameter here.", field=name[:40], remedy=remedy)
        if name in seen and schemas[name].get("type") != "array":
            raise Problem(422, "The parameter comes more than once.", field=name, remedy=f"Send it once. {API_REMEDY}")
        seen.add(name)


def _schemas(connection: HTTPConnection) -> Mapping[str, Mapping[str, Any]]:
    """The schemas of the route's query parameters, by name."""
    path, method = connection.scope["route"].path, connection.scope["method"].lower()
    operation = connection.app.openapi()["paths"].get(path, {}).get(method, {})
    return {each["name"]: each["schema"] for each in operation.get("parameters", ()) if each["in"] == "query"}
