"""results of reobj_track."""
