"""Neural networks: the image encoder that several of them share, and how weights are loaded.

The only modules that import torch; whoever needs one imports it on use, after
``laser_slam.dependencies.import_torch``.
"""
