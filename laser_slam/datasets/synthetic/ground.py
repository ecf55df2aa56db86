"""Looks of what lies on the ground: asphalt with markings, kerbs, pavement, grass. Linear RGB."""

from __future__ import annotations

from typing import Any

import numpy as np

from laser_slam.datasets.synthetic.hit import Hit, ground_noise
from laser_slam.datasets.synthetic.kernels import inlined
from laser_slam.datasets.synthetic.mesh import GROUND, KERB
from laser_slam.datasets.synthetic.streets import HALF_ROAD_M, PAVEMENT_M, Streets, locate
from laser_slam.datasets.synthetic.textures import CLOUDS, GRAIN, LEAVES, band, hash01, pulse
from laser_slam.datasets.synthetic.world import Scene

PARKING_M = 3.4  # the line between the lane and the parked cars
SLAB_M = 0.6


@inlined
def ground_color(scene: Scene, hit: Hit, material: int) -> Any:
    """Return the albedo of ground, pavement or kerb."""
    lateral, along, sample, crossing = locate(scene.streets, hit.x, hit.z)
    dl, da = _footprint(scene.streets, hit, sample)
    grain = ground_noise(scene.textures, GRAIN, hit, 2.3, 0.0)
    coarse = ground_noise(scene.textures, CLOUDS, hit, 17.0, 0.3)
    nearest = min(abs(lateral), crossing)
    if material == KERB:
        joint = pulse(along, 1.0, 0.015, da)
        tone = (0.30 + 0.035 * grain + 0.025 * coarse) * (1 - 0.6 * joint)
        return tone, tone * 0.98, tone * 0.94
    if material == GROUND and nearest < HALF_ROAD_M + 0.1:
        place = (lateral, along, crossing, dl, da)
        return _asphalt(scene, hit, place, grain, coarse)
    if nearest < HALF_ROAD_M + PAVEMENT_M + 0.05:
        return _slabs(lateral, along, (dl, da), grain, coarse)
    return _grass(scene, hit, grain, coarse)


@inlined
def _footprint(streets: Streets, hit: Hit, sample: int) -> Any:
    """Return the pixel's extent across and along the street."""
    tx, tz = streets.tangents[sample, 0], streets.tangents[sample, 1]
    along = abs(hit.mx * tx + hit.mz * tz)
    across = abs(hit.mx * tz - hit.mz * tx)
    return (
        hit.major * across + hit.minor * along + 0.004,
        hit.major * along + hit.minor * across + 0.004,
    )


@inlined
def _asphalt(scene: Scene, hit: Hit, place: Any, grain: float, coarse: float) -> Any:
    lateral, along, crossing, dl, da = place
    middle = ground_noise(scene.textures, CLOUDS, hit, 5.1, 0.7)
    tone = 0.105 + 0.017 * grain + 0.012 * coarse + 0.008 * middle
    rut = abs(abs(abs(lateral) - 1.75) - 0.75)
    tone *= 1.0 - 0.13 * max(0.0, 1.0 - rut / 0.45)
    tone *= 1.0 - 0.25 * max(0.0, 1.0 - abs(HALF_ROAD_M - abs(lateral)) / 0.5)  # gutter
    tone *= _patches(lateral, along, dl, da)
    crack = 1.0 - min(abs(middle + 0.35 * grain) / 0.06, 1.0)
    tone *= 1.0 - 0.45 * crack * max(0.0, 1.0 - hit.major / 0.25)
    paint = band(lateral, -0.065, 0.065, dl) * pulse(along, 9.0, 4.0, da)
    edge = band(abs(lateral), PARKING_M - 0.05, PARKING_M + 0.05, dl)
    paint += edge * pulse(along, 2.0, 1.0, da)
    is_crossing = min(max((7.5 - crossing) / 1.0, 0.0), 1.0)
    paint *= (1.0 - is_crossing) * min(max(0.86 + 0.16 * grain + 0.1 * middle, 0.25), 1.0)
    tone = max(tone, 0.02) * (1 - paint) + 0.62 * paint
    return tone, tone * 0.99, tone * (1.0 - 0.04 * (1 - paint))


@inlined
def _patches(lateral: float, along: float, dl: float, da: float) -> Any:
    """Return the darkening by mended rectangles, drains and their seams."""
    block, lane = int(np.floor(along / 13.0)), int(np.floor(lateral / 2.75))
    start = block * 13.0 + 9.0 * hash01(block, lane, 1)
    length = 1.0 + 4.0 * hash01(block, lane, 2)
    left = lane * 2.75 + 1.2 * hash01(block, lane, 3)
    width = 0.6 + 1.6 * hash01(block, lane, 4)
    width = min(width, (lane + 1) * 2.75 - left)
    length = min(length, (block + 1) * 13.0 - start)
    inside = band(along, start, start + length, da) * band(lateral, left, left + width, dl)
    kind = hash01(block, lane, 5)
    if kind < 0.45:
        return 1.0 - inside * 0.38
    if kind < 0.6:
        return 1.0 + inside * 0.3
    cover = band(along, start, start + 0.6, da) * band(lateral, left, left + 0.6, dl)
    return 1.0 - 0.55 * cover if kind < 0.75 else 1.0


@inlined
def _slabs(lateral: float, along: float, width: Any, grain: float, coarse: float) -> Any:
    dl, da = width
    joint = pulse(along, SLAB_M, 0.018, da)
    joint = max(joint, pulse(lateral, SLAB_M, 0.018, dl))
    fade = max(0.0, 1.0 - max(dl, da) / SLAB_M)
    column, row = int(np.floor(along / SLAB_M)), int(np.floor(lateral / SLAB_M))
    own = (hash01(column, row, 7) - 0.5) * fade
    tone = 0.22 + 0.02 * grain + 0.024 * coarse + 0.085 * own
    tone = max(tone * (1 - 0.6 * joint), 0.02)
    return tone * 1.02, tone * 0.97, tone * 0.88


@inlined
def _grass(scene: Scene, hit: Hit, grain: float, coarse: float) -> Any:
    blades = ground_noise(scene.textures, LEAVES, hit, 1.3, 0.1)
    tufts = ground_noise(scene.textures, LEAVES, hit, 7.9, 0.6)
    tone = max(1.0 + 0.22 * blades + 0.2 * tufts + 0.08 * grain, 0.25)
    dry = min(max(0.35 + 0.4 * coarse + 0.15 * tufts, 0.0), 1.0)
    red, green, blue = 0.055 + 0.085 * dry, 0.10 + 0.035 * dry, 0.022 + 0.02 * dry
    return red * tone, green * tone, blue * tone
