"""Readers: ordered frames, times, intrinsics and truth where a data set has them."""
