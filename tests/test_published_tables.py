"""Each data set of the paper in its layout, through the table that holds it, to a known score.

The street of the synthetic drive is written as each data set lays its files out. A backbone that
recognises the images answers with the truth, or with the truth bent in a known way. So a reader
that gives an image another one's depth or pose, another unit, axis or order, shows in the table.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import layouts
import numpy as np
import pytest
from layouts import Scene
from numpy.typing import NDArray
from quick_runs import leave_pictures_out

from laser_slam.benchmarks import Bench, Material, Setting, fill_grids, load_table
from laser_slam.camera import intrinsics_matrix, unproject
from laser_slam.config import BackboneConfig, load_config
from laser_slam.datasets.synthetic.paths import loop_path
from laser_slam.datasets.synthetic.render import Renderer
from laser_slam.datasets.synthetic.world import build_world
from laser_slam.evaluation import INDOOR_POINTS, PointMap, evaluate_points
from laser_slam.sim3 import Sim3, rotation_exp
from laser_slam.types import NO_DISTORTION, Calibration, Image, Prediction, Window

Array = NDArray[np.float64]

SIZE = (48, 64)
FOCAL_PX = 52.5  # the colour camera of 7-Scenes at a tenth
CENTRE, NRGBD_CENTRE = (31.55, 23.55), (32.0, 24.0)  # NRGBD: half the width and height
MODEL = 0.1  # rooms are a model of the street
NUM = 120
BENT = slice(30, None)  # rows whose depth is bent
FACTOR = 1.3  # of depth there
LEAST = slice(38, None)  # rows that a backbone knows to be bent, fewer than are left out
LIFT, ROLL = 0.02, 0.01  # of every second frame: in lengths of a mean step; radians
TRUE, BENT_DEPTH, BENT_POSES, TOLD = range(4)


@cache
def street() -> Any:
    """Return the world of the synthetic drive, which is seen from all its poses."""
    return build_world(loop_path(NUM, 0.9, 0), 0, 0.0028)


def renderer(centre: tuple[float, float]) -> Renderer:
    return Renderer(street(), intrinsics_matrix(FOCAL_PX, FOCAL_PX, *centre), SIZE)


@cache
def street_images() -> NDArray[np.float32]:
    """Return (N, H, W, 3) images, each of which tells where it was taken."""
    seen = (renderer(CENTRE).image(pose, 0.0, np.random.default_rng(0)) for pose in poses())
    return np.stack(list(seen)).astype(np.float32)


def poses() -> Array:
    return np.asarray(street().world_from_cam)


@cache
def street_depth(centre: tuple[float, float]) -> NDArray[np.float32]:
    """Return (N, H, W) metres."""
    eye = renderer(centre)
    return np.stack([eye.depth(pose) for pose in poses()])


def scene(scale: float, centre: tuple[float, float] = CENTRE) -> Scene:
    """Return the street as a model; frames beyond its ends look black."""

    def pose(frame: int) -> Array:
        world_from_cam = poses()[frame].copy()
        world_from_cam[:3, 3] *= scale
        return np.asarray(world_from_cam)

    def image(frame: int) -> Image:
        if not 0 <= frame < NUM:
            return np.zeros((*SIZE, 3), np.uint8)
        return street_images()[frame].astype(np.uint8)

    def depth(frame: int) -> NDArray[np.float32]:
        return np.asarray(street_depth(centre)[frame] * np.float32(scale))

    return Scene(image, depth, pose, intrinsics_matrix(FOCAL_PX, FOCAL_PX, *centre), SIZE)


@dataclass
class Recognising:
    """A backbone that tells by an image where it was taken, and answers as its kind says.

    Attributes:
        kind: of answer.
        scene: what is true.
        step: of the frames that it is shown.
    """

    kind: int
    scene: Scene
    step: int = 1

    remembers = False
    sees_far_frames = True

    def identity(self) -> dict[str, Any]:
        return {"kind": self.kind}

    def image_size(self, size: tuple[int, int]) -> tuple[int, int]:
        return size

    def calibrate(self, windows: Iterable[Window], intrinsics: Array | None) -> Calibration:
        return Calibration(intrinsics, NO_DISTORTION, SIZE, "given")

    def predict(
        self, images: Sequence[Image], frames: NDArray[np.int64], intrinsics: Array | None
    ) -> Prediction:
        shown = [recognise(image) for image in images]
        world_from_cam = np.stack([self.pose(frame) for frame in shown])
        depth = np.stack([self.depth(frame) for frame in shown])
        unit_m = float(np.random.default_rng(shown[0]).uniform(0.5, 8.0))
        window_from_world = Sim3(1 / unit_m) @ Sim3.from_matrix(world_from_cam[0]).inverse()
        confidence = np.where(np.isfinite(depth), 0.9, 0.0).astype(np.float32)
        if self.kind == TOLD:
            confidence[:, LEAST] *= 0.3
        return Prediction(
            frames,
            depth / np.float32(unit_m),
            confidence,
            window_from_world.apply_poses(world_from_cam),
            np.tile(self.scene.intrinsics, (len(frames), 1, 1)),
        )

    def depth(self, frame: int) -> NDArray[np.float32]:
        depth = self.scene.depth(frame).copy()
        rows = {BENT_DEPTH: BENT, TOLD: LEAST}.get(self.kind, slice(0))
        depth[rows] *= np.float32(FACTOR)
        return depth

    def pose(self, frame: int) -> Array:
        """Return where the camera was; every second one lifted and rolled, or the truth."""
        world_from_cam = self.scene.pose(frame).copy()
        if self.kind == BENT_POSES:
            sign = 1 if frame // self.step % 2 else -1
            roll = np.eye(4)
            roll[:3, :3] = rotation_exp(np.array([0.0, 0.0, sign * ROLL]))
            world_from_cam = world_from_cam @ roll
            world_from_cam[1, 3] += sign * LIFT * step_m(self.scene)
        return np.asarray(world_from_cam)


def step_m(of: Scene) -> float:
    centres = np.stack([of.pose(frame)[:3, 3] for frame in range(NUM)])
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).mean())


def recognise(image: Image) -> int:
    error = np.abs(street_images() - image).mean(axis=(1, 2, 3))
    found = int(error.argmin())
    assert error[found] < 0.7 * np.delete(error, found).min(), "an image of another place"
    return found


@dataclass(frozen=True)
class Case:
    """A sequence of a table in miniature.

    Attributes:
        place: below the data folder, as a user has it.
        write: its layout.
        num: frames that are written.
        used: frames of the street that the table's protocol takes.
        scale: of the model.
        centre: of its camera.
    """

    place: str
    write: Callable[[Path, int, Scene], None]
    num: int
    used: range
    scale: float = MODEL
    centre: tuple[float, float] = CENTRE

    @property
    def scene(self) -> Scene:
        return scene(self.scale, self.centre)


SINTEL = Case("sintel/training/final/alley_2", layouts.sintel, 24, range(24), 1.0)
CASES = {
    ("depth", "sintel-alley_2"): SINTEL,
    ("depth", "bonn-balloon2"): Case(
        "rgbd_bonn_dataset/rgbd_bonn_balloon2", layouts.bonn, 54, range(30, 54)
    ),
    ("depth", "kitti-09-26-0002"): Case(
        "kitti_depth/val/2011_09_26_drive_0002_sync", layouts.kitti_depth, 24, range(24), 1.0
    ),
    ("pose", "sintel-alley_2"): SINTEL,
    ("pose", "scannet-scene0707_00"): Case(
        "scannet/scene0707_00", layouts.scannet, 66, range(0, 66, 3)
    ),
    ("pose", "tum-sitting_static"): Case(
        "tum/rgbd_dataset_freiburg3_sitting_static", layouts.tum, 66, range(0, 66, 3)
    ),
    ("points", "7scenes-redkitchen-03"): Case(
        "7scenes/redkitchen/seq-03", layouts.seven_scenes, NUM, range(0, NUM, 10)
    ),
    ("points", "nrgbd-kitchen"): Case(
        "nrgbd/kitchen", layouts.nrgbd, NUM, range(0, NUM, 10), centre=NRGBD_CENTRE
    ),
    ("waymo", "183829460"): Case(f"waymo/{layouts.SEGMENT}", layouts.waymo, 24, range(24), 1.0),
    ("kitti", "04"): Case(
        "kitti_odometry/sequences/04", layouts.kitti_odometry, NUM, range(NUM), 1.0
    ),
}
SETTINGS = (
    "backbone.name=simulated", "windows.min_parallax_px=0", "calibration.keyframes=0",
    "closures.enabled=false", "run.samples=2", "fusion.stride=4", "registration.min_pixels=50",
)  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All data sets of the paper below one folder."""
    root = tmp_path_factory.mktemp("data")
    for case in {case.place: case for case in CASES.values()}.values():
        case.write(root / case.place, case.num, case.scene)
    return root


@pytest.fixture
def score(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str, str, int], dict[str, float]]:
    """Run one row of a table on one sequence; give the values by their measures."""
    leave_pictures_out(monkeypatch, page=True)

    def run(name: str, sequence: str, kind: int) -> dict[str, float]:
        case = CASES[name, sequence]

        def make(config: BackboneConfig, *_: object) -> Recognising:
            return Recognising(config.simulated.seed, case.scene, case.used.step)

        monkeypatch.setattr("laser_slam.predicting.choice.make_backbone", make)
        table = load_table(name)
        whole = table.sequences[sequence].model_copy(update={"num_frames": len(case.used)})
        table = table.model_copy(update={"sequences": {**table.sequences, sequence: whole}})
        bench = Bench(table, Material(data), tmp_path, only=(sequence,))
        setting = Setting(f"kind {kind}", (*SETTINGS, f"backbone.simulated.seed={kind}"))
        outcomes = bench.run([setting])
        assert outcomes[0].reason is None
        return {
            column.measure: cell.value
            for grid in fill_grids(table, outcomes)
            for column, cell in zip(grid.columns, grid.rows[0].cells, strict=True)
            if isinstance(cell.value, float)
        }

    return run


Score = Callable[[str, str, int], dict[str, float]]


def sequences(name: str) -> list[str]:
    return [sequence for table, sequence in CASES if table == name]


@pytest.mark.parametrize("sequence", sequences("depth"))
def test_depth_tables_score_nothing_for_the_truth_and_the_known_error_for_bent_depth(
    score: Score, sequence: str
) -> None:
    name = sequence.split("-", maxsplit=1)[0]
    right = score("depth", sequence, TRUE)
    assert right[f"{name}_abs_rel"] < 2e-3
    assert right[f"{name}_delta_percent"] > 99.99
    wrong = score("depth", sequence, BENT_DEPTH)
    abs_rel, delta = errors_of_bent_depth(CASES["depth", sequence])
    assert wrong[f"{name}_abs_rel"] == pytest.approx(abs_rel, abs=3e-3)
    assert wrong[f"{name}_delta_percent"] == pytest.approx(100 * delta, abs=0.2)


def errors_of_bent_depth(case: Case) -> tuple[float, float]:
    """Work out Abs Rel and delta of the bent pixels; the others, far ones, rule the scale."""
    depth = np.stack([case.scene.depth(frame) for frame in case.used])
    reach = {"sintel": 70.0, "rgbd_bonn_dataset": 65535 / 5000}.get(case.place.split("/")[0])
    known = np.isfinite(depth) & (depth < (reach or np.inf))
    bent = np.zeros_like(known)
    bent[:, BENT] = known[:, BENT]
    assert depth[known & ~bent].sum() > 2 * FACTOR * depth[bent].sum()
    share = bent.sum() / known.sum()
    return (FACTOR - 1) * float(share), 1 - float(share)


@pytest.mark.parametrize("sequence", sequences("pose"))
def test_pose_tables_score_nothing_for_the_truth_and_the_known_error_for_bent_poses(
    score: Score, sequence: str
) -> None:
    case = CASES["pose", sequence]
    unit_m = step_m(case.scene)
    right = score("pose", sequence, TRUE)
    assert right["ate_m"] < 1e-3 * unit_m
    assert right["rpe_translation_m"] < 1e-3 * unit_m
    assert right["rpe_rotation_deg"] < 1e-3
    wrong = score("pose", sequence, BENT_POSES)
    moved_m, turned_deg = errors_of_bent_motions(case)
    assert wrong["ate_m"] == pytest.approx(LIFT * unit_m, rel=0.01)
    assert wrong["rpe_translation_m"] == pytest.approx(moved_m, rel=0.01)
    assert wrong["rpe_rotation_deg"] == pytest.approx(turned_deg, rel=0.01)


def errors_of_bent_motions(case: Case) -> tuple[float, float]:
    """Compare the motions from frame to frame, word by word."""
    bent = Recognising(BENT_POSES, case.scene, case.used.step)
    moved, turned = [], []
    for first, second in pairwise(case.used):
        true = np.linalg.inv(case.scene.pose(first)) @ case.scene.pose(second)
        found = np.linalg.inv(bent.pose(first)) @ bent.pose(second)
        error = np.linalg.inv(true) @ found
        moved.append(error[:3, 3])
        turned.append(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)))
    moved_m = np.sqrt(np.square(moved).sum(axis=1).mean())
    return float(moved_m), float(np.rad2deg(np.sqrt(np.square(turned).mean())))


@pytest.mark.parametrize("sequence", sequences("points"))
def test_point_tables_score_nothing_for_the_truth_and_the_known_error_for_bent_depth(
    score: Score, sequence: str
) -> None:
    case = CASES["points", sequence]
    right, wrong = (score("points", sequence, kind) for kind in (TRUE, BENT_DEPTH))
    assert right["indoor_acc_m"] < 2e-3
    assert right["indoor_comp_m"] < 2e-3
    assert right["indoor_nc"] > 0.99
    assert_known(wrong, "indoor", case, BENT_DEPTH, case.scene.intrinsics)
    assert wrong["indoor_acc_m"] > 5 * right["indoor_acc_m"]
    # What pi3 and LASER take for true is bent, so that the truth has errors, which are known.
    published = published_intrinsics(case)
    name = sequence.split("-", maxsplit=1)[0]
    assert_known(right, name, case, TRUE, published)
    assert_known(wrong, name, case, BENT_DEPTH, published)


def published_intrinsics(case: Case) -> Array:
    """Return them as LASER's evaluation has them: of 518x392, with one factor for both axes."""
    focal = FOCAL_PX * (554.2562584220408 / 525 if "7scenes" in case.place else 1)
    factor = 392 / SIZE[0]
    wide, high = factor * SIZE[1] / 518, factor * SIZE[0] / 392
    cx, cy = (wide * (case.centre[0] + 0.5) - 0.5, high * (case.centre[1] + 0.5) - 0.5)
    return intrinsics_matrix(wide * focal, high * focal, cx, cy)


def assert_known(
    values: dict[str, float], name: str, case: Case, kind: int, intrinsics: Array
) -> None:
    """Compare with the scores of points that come straight from the renderer."""
    known = evaluate_points(rendered_maps(case, kind, intrinsics), INDOOR_POINTS)
    for ending, value in {
        "acc_m": known.acc_mean_m,
        "acc_median_m": known.acc_median_m,
        "comp_m": known.comp_mean_m,
        "nc": known.nc_mean,
    }.items():
        assert values[f"{name}_{ending}"] == pytest.approx(value, rel=0.03, abs=1e-3), ending


def rendered_maps(case: Case, kind: int, intrinsics: Array) -> list[PointMap]:
    """Give the points of a kind of answer, and the true ones by a camera that is taken for true."""
    answer = Recognising(kind, case.scene)
    maps = []
    for frame in case.used:
        place = Sim3.from_matrix(case.scene.pose(frame))
        true = case.scene.depth(frame)
        true = np.where(true <= 10.0, true, np.float32(np.nan))
        in_cams = unproject(answer.depth(frame), case.scene.intrinsics), unproject(true, intrinsics)
        maps.append(PointMap(*(place.apply(p.reshape(-1, 3)).reshape(*SIZE, 3) for p in in_cams)))
    return maps


def test_the_table_of_streets_leaves_out_what_the_backbone_is_least_sure_of(score: Score) -> None:
    (sequence,) = sequences("waymo")
    for kind in (TRUE, TOLD):
        values = score("waymo", sequence, kind)
        assert values["outdoor_chamfer_m"] < 0.01
    assert score("waymo", sequence, BENT_DEPTH)["outdoor_chamfer_m"] > 0.1


def test_the_table_of_kitti_scores_nothing_for_the_truth_and_the_known_lift(score: Score) -> None:
    right = score("kitti", "04", TRUE)
    assert right["ate_m"] < 0.005
    assert right["t_rel_percent"] < 0.005
    assert right["r_rel_deg_per_100m"] < 0.005
    wrong = score("kitti", "04", BENT_POSES)
    assert wrong["ate_m"] == pytest.approx(LIFT * step_m(CASES["kitti", "04"].scene), rel=0.01)


MONST3R: dict[tuple[str, str], tuple[str, Callable[[Path], Path]]] = {
    ("depth", "bonn-balloon2"): (
        "rgbd_bonn_dataset/rgbd_bonn_balloon2",
        lambda folder: layouts.choose_bonn(folder, 30, 110),
    ),
    ("depth", "kitti-09-26-0002"): (
        "kitti/val/2011_09_26_drive_0002_sync",
        lambda folder: layouts.choose_kitti_depth(folder, 110),
    ),
    ("pose", "scannet-scene0707_00"): (
        "scannetv2/scene0707_00",
        lambda folder: layouts.choose_scannet(folder, 3, 22),
    ),
    ("pose", "tum-sitting_static"): (
        "tum/rgbd_dataset_freiburg3_sitting_static",
        lambda folder: layouts.choose_tum(folder, 3, 90),
    ),
}


@pytest.mark.parametrize("which", MONST3R)
def test_who_has_only_what_monst3r_chose_gets_the_frames_of_the_table(
    which: tuple[str, str], data: Path, tmp_path: Path
) -> None:
    """The table picks frames of a whole sequence; of the chosen ones it must not pick again."""
    case, (place, choose) = CASES[which], MONST3R[which]
    case.write(tmp_path / place, case.num, case.scene)
    chosen = choose(tmp_path / place)
    for name in ("rgb.txt", "color", "proj_depth"):  # without which it is no whole sequence
        if (tmp_path / place / name).exists():
            (tmp_path / place / name).rename(tmp_path / "away")
    spec = load_table(which[0]).sequences[which[1]]
    whole, found = (Material(root).open(spec, load_config()) for root in (data, tmp_path))
    assert chosen == found.info.files[0].parent
    assert whole.info.num_frames == found.info.num_frames == len(case.used)
    for one, other in zip(whole.frames(), found.frames(), strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(
            whole.true_depth(one.index), found.true_depth(other.index), strict=True
        )
    truth, same = whole.info.truth, found.info.truth
    if truth is None or same is None:
        assert truth is same
        return
    assert truth.frames.tolist() == same.frames.tolist()
    np.testing.assert_allclose(truth.world_from_cam, same.world_from_cam, atol=1e-9)


def test_all_nine_data_sets_of_the_paper_go_through_their_tables() -> None:
    readers = {load_table(name).sequences[sequence].reader for name, sequence in CASES}
    assert readers == {
        "kitti", "kitti-depth", "sintel", "bonn", "tum-rgbd", "scannet", "7scenes", "nrgbd", "waymo"
    }  # fmt: skip
