"""Readers: ordered frames, times, intrinsics and truth where a data set has them."""

DATASETS = {
    "kitti": "laser_slam.datasets.kitti:KittiOdometry",
    "kitti-raw": "laser_slam.datasets.kitti_raw:KittiRaw",
    "7scenes": "laser_slam.datasets.seven_scenes:SevenScenes",
    "tum-rgbd": "laser_slam.datasets.tum_rgbd:TumRgbd",
    "bonn": "laser_slam.datasets.bonn:Bonn",
    "scannet": "laser_slam.datasets.scannet:ScanNet",
    "sintel": "laser_slam.datasets.sintel:Sintel",
    "nrgbd": "laser_slam.datasets.nrgbd:Nrgbd",
    "waymo": "laser_slam.datasets.waymo:Waymo",
    "kitti-depth": "laser_slam.datasets.kitti_depth:KittiDepth",
    "images": "laser_slam.datasets.images:ImageFolder",
    "video": "laser_slam.datasets.video:VideoFile",
    "synthetic": "laser_slam.datasets.synthetic.drive:SyntheticDrive",
}
"""Name on the command line -> ``module:Class``, imported on use."""
