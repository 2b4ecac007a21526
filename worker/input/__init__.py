"""Files in, a clip out: frames, tissue masks, camera and, where the layout has it, depth.

Verbs: decode.decode_clip reads untrusted files in a process without network; calibration.rectify aligns the two eyes.
"""
