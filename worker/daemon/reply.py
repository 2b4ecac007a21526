"""What a request comes to before it is sent: bytes with what there is to say of them, or an error."""

from __future__ import annotations

from dataclasses import dataclass

from contract.wire.errors import ErrorCode, IntrasplatError
from contract.wire.notices import Notice
from contract.wire.rendering import PictureCamera


class NotYetError(IntrasplatError):
    """The job has nothing to show yet."""

    code = ErrorCode.NOT_YET


@dataclass(frozen=True)
class Reply:
    """The answer to a request: encoded bytes, the model time that they show (clamped), and warnings.

    iteration: of the snapshot that is shown; None: the scene is finished.
    unseen: share of a render's pixels that no training frame saw.
    gaussians, clip_size, camera: as in WorkerReply.
    level: of detail at which it was drawn (worker/render/detail.py); 0 shows all.
    is_kept: it was made for an earlier request, or its time tells nothing of that of renders.
    more: further parts of the export follow.
    depth_range_mm: of depth in false colours, as in WorkerReply.
    """

    body: bytes
    media_type: str
    t: float
    warnings: tuple[Notice, ...] = ()
    iteration: int | None = None
    unseen: float = 0.0
    gaussians: int = 0
    clip_size: tuple[int, int] | None = None
    level: int = 0
    is_kept: bool = False
    more: bool = False
    depth_range_mm: tuple[float, float] | None = None
    camera: PictureCamera | None = None
