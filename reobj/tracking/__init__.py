"""Tracking: assignment, camera motion, 3D positions, linking, interpolation."""
