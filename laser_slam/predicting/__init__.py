"""Windows with what a backbone says of them: predicted now, or replayed."""

from laser_slam.predicting.choice import make_source
from laser_slam.predicting.cluster import Fleet
from laser_slam.predicting.job import Job
from laser_slam.predicting.settling import settle
from laser_slam.predicting.sources import Source

__all__ = ["Fleet", "Job", "Source", "make_source", "settle"]
