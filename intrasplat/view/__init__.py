"""A scene, a time, a pose and a camera in; colour, depth, confidence and the unseen pixels out.

Verbs: view.render_frame, unseen.hatched, encode.encode_layer, measured.measured.
"""
