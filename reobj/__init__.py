"""Modules used by reobj_track.py: sources, appearance, tracking, poses, objects, results."""

__version__ = "0.2.0"
