"""The arrays that the decoding process leaves: read or mapped, and refused where they are not what they should be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intrasplat.decode.handover import ArrayFile, map_array


@pytest.mark.parametrize("left", [b"", bytes(11), bytes(13)])
def test_an_array_of_the_wrong_size_is_refused(tmp_path: Path, left: bytes) -> None:
    (tmp_path / "left").write_bytes(left)
    with pytest.raises(ValueError, match="bytes, not 12"):
        map_array(tmp_path, "left", (1, 2, 2))


def test_a_link_in_the_place_of_an_array_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(bytes(12))
    (tmp_path / "left").symlink_to(tmp_path / "secret")
    with pytest.raises(OSError, match="symbolic links"):
        map_array(tmp_path, "left", (1, 2, 2))


def test_a_frame_is_read_as_soon_as_it_is_there(tmp_path: Path) -> None:
    (tmp_path / "left").write_bytes(bytes(range(24)) + bytes(5))
    file = ArrayFile(tmp_path, "left", (3, 2, 2))
    np.testing.assert_array_equal(file.frame(1), np.arange(12, 24, dtype=np.uint8).reshape(2, 2, 3))
    with pytest.raises(ValueError, match="ends at byte 29"):
        file.frame(2)
    with pytest.raises(ValueError, match="another size"):
        file.whole()
