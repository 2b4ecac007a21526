"""Jobs from the queue in, scenes and renders out: the long-running worker of a service.

supervisor.py and consume.py hold the claim without torch; device.py is the child that trains and renders.
"""
