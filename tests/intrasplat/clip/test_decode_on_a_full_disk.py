"""A decoder that a full disk ends: the clip is not to blame."""

from __future__ import annotations

from pathlib import Path

import pytest

from intrasplat.files.disk import Disk
from intrasplat.files.disk_errors import StoreFullError
from tests.intrasplat.decode.test_decode import run_stand_in


@pytest.mark.parametrize("work", ["import os; os.abort()", "raise FileNotFoundError('no usable temporary directory')"])
def test_what_ends_a_decoder_on_a_full_disk_is_not_blamed_on_the_clip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, work: str
) -> None:
    monkeypatch.setattr(Disk, "is_full", lambda disk: True)
    with pytest.raises(StoreFullError):
        run_stand_in(tmp_path, work)
