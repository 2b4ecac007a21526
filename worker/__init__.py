"""The worker of a service: a process that claims jobs, trains scenes and renders them.

In: jobs from the queue, render and export requests. Out: scenes in the store, replies. Verbs: supervisor.run_supervisor
claims jobs and watches its child process without torch; device.run_device is that child, which trains and renders.
"""
