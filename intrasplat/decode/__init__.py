"""Untrusted files in; a clip and its calibration out, read by a confined process. Verb: decode_clip."""

from intrasplat.decode.contained import DecoderKilledError, keep_decoder_ready
from intrasplat.decode.decoding import StereoRecording, decode_clip

__all__ = ["DecoderKilledError", "StereoRecording", "decode_clip", "keep_decoder_ready"]
