"""sources of reobj_track."""
