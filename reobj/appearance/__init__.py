"""Appearance: embeddings of detections, and what their similarity means."""
