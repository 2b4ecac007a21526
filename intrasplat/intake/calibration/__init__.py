"""Text in; a stereo calibration out, checked for plausibility and for its fit to a clip.

OpenCV's files need a C++ parser, which runs in the decoding process (intrasplat/clip/calibration/files.py).
"""
