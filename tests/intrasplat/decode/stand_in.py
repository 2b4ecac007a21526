"""A program in the place of the decoder."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

from intrasplat.decode.contained import Decoder
from intrasplat.decode.guard import Allowance

ALLOWANCE = Allowance(memory_bytes=1 << 30, file_bytes=1 << 20, cpu_s=60)
WITHOUT_LIBRARIES = (
    "import sys, types\n"
    "from importlib.util import find_spec\n"
    "package = types.ModuleType('intrasplat.decode')\n"
    "package.__path__ = find_spec('intrasplat').submodule_search_locations[0] + '/decode',\n"
    "sys.modules[package.__name__] = package\n"
)
"""What a stand-in begins with: the package is there, without NumPy and OpenCV, which take most of a decoder's start."""


def run_stand_in(tmp_path: Path, work: str, *, before: str = "", **more: Any) -> dict[str, Any]:
    """The result of a process that does `work` where the decoder would be, and `before` when it starts."""
    script = tmp_path / "stand_in.py"
    lines = "\n    ".join(work.splitlines())
    script.write_text(
        f"{before}{WITHOUT_LIBRARIES}from intrasplat.decode.child import serve\n"
        f"def work(request, folder, reports):\n    {lines}\n    return {{}}\n"
        "serve(lambda: work)\n"
    )
    request = {"readable": more.pop("readable", [])}
    with closing(Decoder((str(script),))) as decoder:
        decoder.ask(request, more.pop("allowance", ALLOWANCE), **more)
        return decoder.until_ended()
