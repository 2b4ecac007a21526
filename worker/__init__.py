"""The long-running worker of a service.

In: jobs from the queue, render and export requests. Out: scenes in the store, replies. Verbs: supervisor.run_supervisor
claims jobs and watches its child without torch; device.run_device is that child, which trains and renders.
"""
