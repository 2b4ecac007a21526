"""The reply to a request before it is sent: bytes with their description, or an error."""

from __future__ import annotations

from dataclasses import dataclass

from contract.wire.feeds import CutRange, FeedShown
from contract.wire.rendering import PictureCamera
from intrasplat.errors import ErrorCode, IntrasplatError
from intrasplat.notices import Notice


class NotYetError(IntrasplatError):
    """The job has no snapshot to show yet."""

    code = ErrorCode.NOT_YET


@dataclass(frozen=True)
class Reply:
    """The answer to a request: encoded bytes, the model time that they show (clamped to the clip), and warnings.

    iteration: iteration of the snapshot that is shown; None: the scene is finished.
    unseen: share of a render's pixels that no training frame saw.
    detail: share of a render's tissue whose detail comes from recorded frames.
    gaussians, clip_size, camera, depth_range_mm, feed, cut: as in WorkerReply.
    level: level of detail at which it was rendered (intrasplat/view/coarse.py); 0 is full detail.
    is_untimed: the reply comes from the cache or is no render; its time is not used to predict that of renders.
    more: further parts of the export follow.
    """

    body: bytes
    media_type: str
    t: float
    warnings: tuple[Notice, ...] = ()
    iteration: int | None = None
    unseen: float = 0.0
    detail: float = 0.0
    gaussians: int = 0
    clip_size: tuple[int, int] | None = None
    level: int = 0
    is_untimed: bool = False
    more: bool = False
    depth_range_mm: tuple[float, float] | None = None
    camera: PictureCamera | None = None
    feed: FeedShown | None = None
    cut: CutRange | None = None
