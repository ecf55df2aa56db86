"""Pictures of the cloud: from above, from a bird's height, and from the driver's seat."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from scipy.spatial import cKDTree

from laser_slam.camera import resize_intrinsics
from laser_slam.report.splat import Viewpoint, project_points, render_points
from laser_slam.report.style import ACCENT, INK, MUTED, mark_ends, picture, round_length
from laser_slam.report.viewpoints import from_above, from_bird, from_driver
from laser_slam.types import Cloud, Image, Trajectory


class CloudView(StrEnum):
    """From where a cloud is seen."""

    ABOVE = "above"
    BIRD = "bird"
    DRIVER = "driver"


_PLACES = {
    CloudView.ABOVE: from_above,
    CloudView.BIRD: from_bird,
    CloudView.DRIVER: from_driver,
}
_SMOOTH = 2
_SKIES = {  # top and bottom of the background
    CloudView.ABOVE: ((255, 255, 255), (255, 255, 255)),
    CloudView.BIRD: ((226, 233, 240), (255, 255, 255)),
    CloudView.DRIVER: ((158, 192, 224), (247, 249, 251)),
}


def cloud_picture(
    path: Path,
    cloud: Cloud,
    trajectory: Trajectory,
    view: CloudView,
    *,
    unit: str = "world units",
    like: Cloud | None = None,
) -> None:
    """Draw the cloud in one of the views, with the trajectory over it unless from the seat.

    Args:
        path: of the PNG file.
        cloud: in world units; an empty one gives a picture that says so.
        trajectory: of the camera, at least one pose; tells what is down and forward.
        view: above (parallel, the whole map), bird (oblique) or driver (along the road).
        unit: of the world, for the scale bar.
        like: another cloud, to be seen from where that one is; None: from where it suits this one.

    Raises:
        RunFolderError: the picture cannot be written.
    """
    viewpoint = _PLACES[view](cloud if like is None else like, trajectory)
    image = _render_smooth(_with_size(cloud), viewpoint, view)
    height, width = viewpoint.size
    with picture(path, height, layout=None) as figure:
        axes = figure.add_axes((0, 0, 1, 1), frameon=False)
        axes.imshow(image, interpolation="nearest", aspect="auto")
        axes.set_axis_off()
        if view is not CloudView.DRIVER:
            _draw_path(axes, trajectory, viewpoint)
        if viewpoint.parallel:
            _draw_scale(axes, viewpoint, unit)
        if not len(cloud.points):
            axes.text(width / 2, height / 2, "no points", ha="center", color=MUTED, fontsize=14)
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def _with_size(cloud: Cloud) -> Cloud:
    """Give a cloud without voxel size the median distance between neighbours."""
    if cloud.voxel_size > 0 or len(cloud.points) < 2:
        return cloud
    queries = cloud.points[:: max(1, len(cloud.points) // 2000)]
    distance, _ = cKDTree(cloud.points).query(queries, k=2)
    return replace(cloud, voxel_size=float(np.median(distance[:, 1])))


def _render_smooth(cloud: Cloud, viewpoint: Viewpoint, view: CloudView) -> Image:
    """Render in twice the size and average, so that outlines have no steps."""
    height, width = viewpoint.size
    size = (_SMOOTH * height, _SMOOTH * width)
    intrinsics = resize_intrinsics(viewpoint.intrinsics, viewpoint.size, size)
    large = replace(viewpoint, intrinsics=intrinsics, size=size)
    image, _ = render_points(cloud, large, _background(view, size))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _background(view: CloudView, size: tuple[int, int]) -> Image:
    """Return white paper for the plan, a hint of sky for the rest."""
    height, width = size
    top, bottom = np.array(_SKIES[view])
    share = np.linspace(0, 1, height)[:, None]
    column = np.rint((1 - share) * top + share * bottom).astype(np.uint8)
    return np.repeat(column[:, None], width, axis=1)


def _draw_path(axes: Axes, trajectory: Trajectory, viewpoint: Viewpoint) -> None:
    pixels = project_points(trajectory.world_from_cam[:, :3, 3], viewpoint).astype(np.float64)
    pixels[pixels[:, 2] <= 0] = np.nan
    halo = [withStroke(linewidth=4.5, foreground="white", alpha=0.85)]
    axes.plot(pixels[:, 0], pixels[:, 1], color=ACCENT, linewidth=2.2, path_effects=halo)
    mark_ends(axes, pixels)
    axes.legend(loc="upper right", borderaxespad=1.2)


def _draw_scale(axes: Axes, viewpoint: Viewpoint, unit: str) -> None:
    """Draw a bar of a round length at the lower left."""
    height, width = viewpoint.size
    per_unit = float(viewpoint.intrinsics[0, 0])
    length = round_length(0.2 * width / per_unit)
    left, bottom = 0.03 * width, height - 0.03 * width
    halo = [withStroke(linewidth=7, foreground="white")]
    ends = [left, left + length * per_unit]
    axes.plot(ends, [bottom] * 2, color=INK, linewidth=3, path_effects=halo, solid_capstyle="butt")
    halo = [withStroke(linewidth=4, foreground="white")]
    text = f"{length:g} {unit}"
    axes.text(left, bottom - 12, text, va="bottom", fontsize=10, path_effects=halo)
