"""Geometry on the CPU: tracks, bundle adjustment, plane sweep."""
