"""Where the files of the page for the browser are."""

from __future__ import annotations

from pathlib import Path

DASHBOARD = Path(__file__).resolve().parent / "dashboard"
