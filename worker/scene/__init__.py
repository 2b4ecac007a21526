"""A trained model in, files out, and back: manifest and scene.safetensors, their compact form, exports.

Verbs: checkpoint.save_scene, checkpoint.load_scene, export.
"""
