"""Camera poses: reconstructed from a video, or supplied by other tools and checked."""
