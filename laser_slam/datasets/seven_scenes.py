"""One sequence of Microsoft's 7-Scenes: a hand-held depth camera in a room, with poses."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.listed import Lens, ListedSequence, Shot
from laser_slam.datasets.poses import read_pose
from laser_slam.errors import DatasetError

FPS = 30.0
LENS = Lens(  # of the official page
    intrinsics_matrix(585.0, 585.0, 320.0, 240.0), "7-Scenes, nominal", (480, 640)
)
UNITS_PER_M = 1000.0
INVALID = (0, 65535)
COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(png|jpe?g)", re.IGNORECASE)
AGAIN = "unpack the sequence again"


class SevenScenes(ListedSequence):
    """One sequence: ``frame-000000.color.png`` (or .jpg), ``.depth.png`` and ``.pose.txt`` each.

    Depth is that of the depth camera, 16 bits, in millimetres; it is taken as registered with the
    colour camera, which the release does not promise (off by some pixels). A frame whose pose is
    missing, not finite or no rigid motion has no true pose. There are no times: 30 frames a
    second by the number in the name, so frames that were left out leave a gap.

    Args:
        folder: of one sequence, such as ``kitchen/seq-01``.

    Raises:
        DatasetError: no such images there, images of several sizes, or a pose file that does not
            hold 16 numbers.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        named = folder.resolve()
        super().__init__(
            f"7scenes-{named.parent.name}-{named.name}",
            [_shot(number, path) for number, path in _list_frames(folder).items()],
            LENS,
            partial(read_depth, units_per_m=UNITS_PER_M, advice=AGAIN, invalid=INVALID),
        )


def _shot(number: int, color: Path) -> Shot:
    depth = _beside(color, "depth.png")
    pose = read_pose(_beside(color, "pose.txt"), AGAIN)
    return Shot(number / FPS, color, depth if depth.is_file() else None, pose)


def _beside(color: Path, ending: str) -> Path:
    return color.with_name(f"{color.name.split('.')[0]}.{ending}")


def _list_frames(folder: Path) -> dict[int, Path]:
    """List the colour images in order, by the numbers in their names."""
    if not folder.is_dir():
        raise DatasetError(f"no folder {folder}; give the folder of one 7-Scenes sequence")
    matches = ((COLOR_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    found = {int(match[1]): path for match, path in matches if match is not None}
    if not found:
        inside = sorted(path.name for path in folder.iterdir() if path.is_dir())
        listed = f" (folders there: {', '.join(inside[:20])})" if inside else ""
        raise DatasetError(
            f"no images such as frame-000000.color.png in {folder}{listed}; "
            "give the folder of one 7-Scenes sequence"
        )
    return {number: found[number] for number in sorted(found)}
