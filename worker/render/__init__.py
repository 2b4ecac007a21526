"""A scene, a time, a pose and a camera in; colour, depth and confidence out.

Verbs: view.render_frame, encode.encode_layer.
"""
