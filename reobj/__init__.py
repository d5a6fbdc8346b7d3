"""Rooms of reobj_track: what the tool uses; start reading at reobj_track.py."""

__version__ = "0.2.0"
