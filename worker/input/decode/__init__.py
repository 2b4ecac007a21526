"""Files from outside in; a clip and its calibration out, read by a confined process. Verb: decode_clip."""

from worker.input.decode.contained import keep_decoder_ready
from worker.input.decode.decoding import StereoRecording, decode_clip

__all__ = ["StereoRecording", "decode_clip", "keep_decoder_ready"]
