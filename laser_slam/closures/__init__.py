"""Closures: a candidate measured and judged, and one record of it."""
