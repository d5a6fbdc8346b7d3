"""Map of a room: objects that keep their numbers over several recordings."""
