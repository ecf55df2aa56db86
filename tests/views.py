"""Views of streets of their own, for tests that tell places apart."""

from functools import cache

from laser_slam.config import SyntheticConfig
from laser_slam.datasets.synthetic.drive import SyntheticDrive
from laser_slam.types import Image


@cache
def street_views(num_frames: int = 16, step_m: float = 4.0, seed: int = 5) -> list[Image]:
    """Return views of a street, some metres apart."""
    config = SyntheticConfig(num_frames=num_frames, width=640, height=192, step_m=step_m, seed=seed)
    return [frame.image for frame in SyntheticDrive(config).frames() if frame.image is not None]
