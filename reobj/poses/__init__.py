"""poses of reobj_track."""
