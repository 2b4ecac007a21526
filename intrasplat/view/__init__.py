"""Render a scene.

In: a scene, a time, a pose and a camera. Out: colour, depth, confidence and the unseen pixels.
Verbs: view.render_frame, unseen.hatched, encode.encode_layer, measured.measured.
"""
