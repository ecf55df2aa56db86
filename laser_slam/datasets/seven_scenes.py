"""One sequence of Microsoft's 7-Scenes: a hand-held depth camera in a room, with poses."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from laser_slam.camera import intrinsics_matrix
from laser_slam.datasets.decoding import read_depth
from laser_slam.datasets.lens import Lens
from laser_slam.datasets.listed import ListedSequence, Shot
from laser_slam.datasets.poses import read_pose
from laser_slam.errors import DatasetError

FPS = 30.0
RAW, MOVED = "depth.png", "depth.proj.png"  # of the depth camera; moved to the colour camera
LENSES = {
    RAW: Lens(  # of the official page
        intrinsics_matrix(585.0, 585.0, 320.0, 240.0),
        "7-Scenes, nominal of the depth camera",
        (480, 640),
    ),
    MOVED: Lens(  # of the script that moves
        intrinsics_matrix(525.0, 525.0, 320.0, 240.0),
        "7-Scenes, of the colour camera that .depth.proj.png was moved to",
        (480, 640),
    ),
}
UNITS_PER_M = 1000.0
INVALID = (0, 65535)
COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(png|jpe?g)", re.IGNORECASE)
AGAIN = "unpack the sequence again"


class SevenScenes(ListedSequence):
    """One sequence: ``frame-000000.color.png`` (or .jpg), ``.depth.png`` and ``.pose.txt`` each.

    Depth is 16 bits, in millimetres. The official ``.depth.png`` is as the depth camera saw it,
    and is taken as registered with the colour camera, which it is not: it is off by some pixels,
    and its focal length is 585 pixels. Where ``.depth.proj.png`` lies beside, which published
    evaluations make of it (SimpleRecon's script), that is read instead, for all frames: the same
    depth as the colour camera sees it, 525 pixels.

    The poses are the depth camera's. A frame whose pose is missing, not finite or no rigid motion
    has no true pose. There are no times: 30 frames a second by the number in the name, so frames
    that were left out leave a gap.

    Args:
        folder: of one sequence, such as ``redkitchen/seq-03``.

    Raises:
        DatasetError: no such images there, images of several sizes, or a pose file that does not
            hold 16 numbers.
    """

    again = AGAIN

    def __init__(self, folder: Path) -> None:
        named = folder.resolve()
        frames = _list_frames(folder)
        is_moved = any(_beside(path, MOVED).is_file() for path in frames.values())
        depth = MOVED if is_moved else RAW
        super().__init__(
            f"7scenes-{named.parent.name}-{named.name}",
            [_shot(number, path, depth) for number, path in frames.items()],
            LENSES[depth],
            partial(read_depth, units_per_m=UNITS_PER_M, advice=AGAIN, invalid=INVALID),
        )


def _shot(number: int, color: Path, ending: str) -> Shot:
    depth = _beside(color, ending)
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
        zipped = sorted(path.name for path in folder.glob("seq-*.zip"))
        if zipped and not inside:
            raise DatasetError(f"{folder} holds {zipped[0]}; unpack it, and give its folder")
        raise DatasetError(
            f"no images such as frame-000000.color.png in {folder}{listed}; "
            "give the folder of one 7-Scenes sequence"
        )
    return {number: found[number] for number in sorted(found)}
