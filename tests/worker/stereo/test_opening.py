"""A clip whose decoding process is killed from outside is decoded again, and not without end."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.wire.options import ReconstructionOptions
from worker.input.decode import DecoderKilledError, decode_clip
from worker.machine.hooks import Hooks
from worker.machine.timing import Timings
from worker.phantom import PhantomSettings, make_phantom, write_endonerf
from worker.stereo import ClipPaths, open_with_depth, opening


@pytest.mark.parametrize("deaths", [0, opening.TRIES - 1, opening.TRIES])
def test_a_killed_decoder_is_tried_again(deaths: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_endonerf(make_phantom(PhantomSettings(width=64, height=48, frames=3)), tmp_path)
    left = deaths

    def decode(*arguments: object, **named: object) -> object:
        nonlocal left
        if left:
            left -= 1
            raise DecoderKilledError
        return decode_clip(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(opening, "decode_clip", decode)
    options = ReconstructionOptions(holdout="none")
    if deaths == opening.TRIES:
        with pytest.raises(DecoderKilledError):
            open_with_depth(ClipPaths(tmp_path), options, Hooks(), Timings())
    else:
        assert open_with_depth(ClipPaths(tmp_path), options, Hooks(), Timings()).frame_count == 3
