"""The bridge to 3D Slicer: a service's scene goes in, OpenIGTLink messages come out, and poses come back.

command.py is `intrasplat slicer`; bridge.py decides what is shown; link.py carries messages to and from peers;
messages.py writes and reads them with pyigtl; clip.py is what the bridge must know of a scene; frames.py turns our
world into Slicer's. docs/slicer.md tells users.
"""
