"""identity of reobj_track."""
