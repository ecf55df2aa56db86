"""Turn kilometres of video from one camera into a dense map: streaming windows, Sim(3), loops."""

__version__ = "0.1.0"
