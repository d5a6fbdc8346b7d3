"""What comes in: frames, weights, recorded detections, detectors."""
