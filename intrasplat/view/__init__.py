"""Render a scene.

In: a scene, a time, a pose and a camera. Out: colour, depth, confidence and the unseen pixels.
Verbs: render.render_frame, unseen.hatched, encode.encode_layer, measured.measured.
"""
