"""The bridge to 3D Slicer: a service's scene goes in, OpenIGTLink messages come out, and poses come back.

command.py is `intrasplat slicer`; bridge.py decides what is shown; link.py carries messages to and from peers;
messages.py writes and reads them with pyigtl; playback.py, surface.py and status.py are the moment, mesh and text that
are shown; frames.py turns our world into Slicer's. docs/slicer.md tells users.
"""
