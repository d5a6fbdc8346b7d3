"""Inputs: frames, weights, recorded detections, detectors."""
