"""Camera poses made by other tools: readers, frame assignment, choice between readings."""
