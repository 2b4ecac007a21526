"""`python -m intrasplat.decode.child`: the process that reads untrusted files.

It loads the decoders, reads one request as JSON from stdin, confines itself, and only then opens untrusted files. It
answers in lines of JSON: any number of {"pictures": ..., "frames": ..., "share": ..., "field": ...}; for a stereo clip
one {"opened": ...} before its first frame; then one {"result": ...} or {"error": ...}.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from intrasplat.decode.guard import Allowance, lock_in
from intrasplat.decode.reports import Reports
from intrasplat.errors import InputError, LimitError

Work = Callable[[dict[str, Any], Path, Reports], dict[str, Any]]
"""work(request, folder for the arrays, reports); returns the result."""


def serve(work_of: Callable[[], Work]) -> None:
    """Import the libraries by work_of, read the request, confine this process, do the work, and answer.

    The process may start long before there is a request. It ends without one if its parent ends.
    """
    with os.fdopen(os.dup(1), "wb") as stream:
        os.dup2(2, 1)  # libraries' output must not mix with the answer
        work = work_of()
        line = sys.stdin.buffer.readline()
        if not line:
            return
        request = json.loads(line)
        folder = Path.cwd()
        granted = lock_in(Allowance(**request["allowance"]), [Path(each) for each in request["readable"]], folder)
        if os.getppid() != request["parent"]:  # the parent ended before lock_in could register for its death
            return
        reports = Reports(stream, granted)
        try:
            reports.end(work(request, folder, reports))
        except Exception as error:
            reports.fail(_described(error))


def _described(error: Exception) -> dict[str, Any]:
    if isinstance(error, InputError):
        description = {"field": error.field, "problem": error.problem, "remedy": error.remedy}
        return description | {"kind": "limit" if isinstance(error, LimitError) else "input"}
    if isinstance(error, MemoryError):
        return {"kind": "memory"}
    places = "".join(traceback.format_tb(error.__traceback__))
    return {"kind": "fault", "type": type(error).__name__, "errno": getattr(error, "errno", None), "where": places}


def _decode() -> Work:
    from intrasplat.decode.reading import read_clip

    return read_clip


if __name__ == "__main__":
    serve(_decode)
