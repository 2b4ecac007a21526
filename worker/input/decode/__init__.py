"""Stage 3: a clip and its calibration are read by a process that has nothing else, and handed over as plain arrays."""

from worker.input.decode.decoding import StereoRecording, decode_clip

__all__ = ["StereoRecording", "decode_clip"]
