"""A generated street world: images, depth and poses along any path."""
