"""Store a trained scene on disk, exact or compact, and load it again.

In: a TrainedScene. Out: scene.safetensors and manifest.json, and the scene again; the state of a stopped run.
Verbs: checkpoint.save_scene, load_scene; resume_file.begin_resume, load_resume; quantize.prepare, rounding;
compact.unpack.
"""
