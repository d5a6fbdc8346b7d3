"""Camera poses and depth maps from the user: readers, assignment to frames, choice of a reading."""
