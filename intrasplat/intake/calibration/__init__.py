"""What a stereo calibration is, which ones no endoscope has, whether one goes with a clip: text in, calibration out.

OpenCV's files need a parser in C++, which runs where clips are decoded (intrasplat/clip/calibration/files.py).
"""
