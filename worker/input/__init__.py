"""Files in; a clip out: frames, tissue masks, camera, and depth if the files have it.

clip.open_clip reads files and clip.split_frames holds frames out. calibration.load_calibration and
calibration.rectify handle the cameras. decode.decode_clip reads clip and calibration in a confined process.
"""
