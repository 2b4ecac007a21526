"""The folder of the web page's files."""

from __future__ import annotations

from pathlib import Path

DASHBOARD = Path(__file__).resolve().parent / "dashboard"
