"""The bridge to 3D Slicer: it sends a service's scene as OpenIGTLink messages, and receives poses and commands.

command.py is `intrasplat slicer`; bridge.py decides what is shown; link.py sends and receives messages; messages.py
encodes and decodes them with pyigtl; playback.py, surface.py and status.py give the shown moment, mesh and text;
frames.py converts our coordinates to Slicer's. docs/slicer.md is the manual.
"""
