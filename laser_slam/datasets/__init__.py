"""Readers: ordered frames, times, intrinsics and truth where a data set has them."""

DATASETS = {
    "kitti": "laser_slam.datasets.kitti:KittiOdometry",
    "7scenes": "laser_slam.datasets.seven_scenes:SevenScenes",
    "images": "laser_slam.datasets.images:ImageFolder",
    "video": "laser_slam.datasets.video:VideoFile",
    "synthetic": "laser_slam.datasets.synthetic.drive:SyntheticDrive",
}
"""Name on the command line -> ``module:Class``, imported on use."""
