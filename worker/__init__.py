"""The reconstruction, one stage a module; read in the order of pipeline.py."""
