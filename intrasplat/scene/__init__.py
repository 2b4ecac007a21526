"""Store a trained scene on disk, exact or compact, and load it again.

In: a Scene (scene.py). Out: scene.safetensors and manifest.json, and the Scene again; the state of a stopped run.
Verbs: checkpoint.save_scene, load_scene; resume_file.begin_resume, load_resume; quantize.prepare, rounding;
compact.unpack.
"""
