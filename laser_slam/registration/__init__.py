"""The Sim(3) between two windows that share frames: a robust scale, then camera anchors.

Reference: LASER (arXiv:2512.13680), supplement A. Differs: the scale multiplies the current window
(the printed equation has the inverse direction), by default it comes from log-ratios, which know no
unit and give far pixels no leverage, and the anchors' length balances the two kinds of noise.
"""

from laser_slam.registration.guess import bridge
from laser_slam.registration.measure import register

__all__ = ["bridge", "register"]
