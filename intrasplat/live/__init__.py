"""A feed followed while it runs: pairs in, a model of the newest moment and of the past out.

Verbs: Follower.add, Follower.scene_at.
"""
