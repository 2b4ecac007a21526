"""Names of the files that callers save: after the scene's label, in any script, safe on every system."""

from __future__ import annotations

import re
import time
import unicodedata
from urllib.parse import quote

ID_DIGITS = 8
UNSAFE = re.compile(r"[^\w.-]+")


def stem_of(label: str | None, created_at_s: float, scene_id: str) -> str:
    """A file's name without its ending: of the label, or of the day (UTC) and the beginning of the id."""
    stem = UNSAFE.sub("_", unicodedata.normalize("NFC", label or "")).strip("._")
    return stem or f"scene-{time.strftime('%Y-%m-%d', time.gmtime(created_at_s))}-{scene_id[:ID_DIGITS]}"


def attachment(name: str) -> str:
    """Content-Disposition of a file to save (RFC 6266)."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    extended = "" if plain == name else f"; filename*=UTF-8''{quote(name)}"
    return f'attachment; filename="{plain}"{extended}'
