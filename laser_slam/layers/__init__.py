"""Layer-wise scale alignment: depth in layers, each with a scale of its own."""
