"""The paper's ablation tables of layer-wise scale alignment, on any data with ground truth.

python tools/ablate_lsa.py demo
python tools/ablate_lsa.py 7scenes DIR --backbone classical
python tools/ablate_lsa.py kitti DIR --sequence 00 --rows "ours,w/o LSA,paper,official"

Every window is predicted once for all rows that cut the same windows. Depth of every frame, from
the window that owns it, is compared with the truth after one scale for the whole video (median of
the ratios); poses after one Sim(3).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from laser_slam.backbones import make_backbone
from laser_slam.camera import resize_intrinsics
from laser_slam.config import Config, load_config, shipped_configs
from laser_slam.datasets.base import Dataset
from laser_slam.errors import LaserSlamError
from laser_slam.evaluation.depth import evaluate_depth
from laser_slam.evaluation.trajectory import evaluate_trajectory
from laser_slam.layers import apply_layers, smooth_layers
from laser_slam.rectification import Rectifier, reduce_images
from laser_slam.slam import Slam
from laser_slam.store import WindowFiles
from laser_slam.types import NO_DISTORTION, Calibration, Layers, Prediction, Window
from laser_slam.windows import cut_windows, select_keyframes

Depth = NDArray[np.float32]
MAX_PIXELS = 4_000_000  # of all depth maps together


class Row(NamedTuple):
    """One line of the table: a shipped settings file, and what differs from it."""

    config: str | None
    assignments: tuple[str, ...] = ()


ON = "layers.enabled=always"
ROWS = {
    "ours": Row(None, (ON,)),
    "w/o LSA": Row(None, ("layers.enabled=never",)),
    "paper": Row("paper", (ON,)),
    "official": Row("official", (ON,)),
    "w/o intra": Row(None, (ON, "layers.intra=false")),
    **{
        f"tau {tau}": Row(None, (ON, f"layers.tau_inter={tau}", f"layers.tau_intra={tau}"))
        for tau in (0.2, 0.3, 0.4, 0.5, 0.6)
    },
    "w/o IRLS": Row(None, (ON, "registration.scale=closed_form", "layers.scale=closed_form")),
    "w/o Anchor": Row(None, (ON, "registration.rigid=points")),
    "w/o curve": Row(None, (ON, "layers.curve=false")),
    "w/o shrinking": Row(None, (ON, "layers.shrink=false")),
    "w/o second pass": Row(None, (ON, "layers.smooth=false")),
    "w/o memory": Row(None, (ON, "layers.memory=0")),
    "w/o feathering": Row(None, (ON, "layers.feather=0")),
    "full resolution": Row(None, (ON, "layers.segmentation.downscale=1")),
    "with feedback": Row(None, (ON, "layers.feed_back=true")),
    "label files": Row(None, (ON, "layers.segmentation.segmenter=label_files")),
    "paper w/o LSA": Row("paper", ("layers.enabled=never",)),
    "paper w/o intra": Row("paper", (ON, "layers.intra=false")),
    "L 10": Row(None, (ON, "windows.size=10")),
    "L 40": Row(None, (ON, "windows.size=40")),
    "O 2": Row(None, (ON, "windows.overlap=2")),
    "O 10": Row(None, (ON, "windows.overlap=10")),
}
NEED_MORE = ("label files",)  # with --set layers.segmentation.label_folder=DIR
DEFAULT_ROWS = ",".join(name for name in ROWS if name not in NEED_MORE)


class Result(NamedTuple):
    """What a row of the table says."""

    abs_rel: float | None
    delta_125: float | None
    mismatch: float | None
    ate_m: float | None
    reached: float | None


class Predictions:
    """The windows of a data set, predicted once and kept in a folder."""

    def __init__(self, dataset: Dataset, config: Config, folder: Path, num_frames: int) -> None:
        self.files = WindowFiles(folder)
        (folder / "windows").mkdir(parents=True)
        info = dataset.info
        backbone = make_backbone(config.backbone, info, dataset.true_depth)
        size = backbone.image_size(info.size)
        given = info.intrinsics
        if given is not None:
            given = resize_intrinsics(given, info.size, size)

        def windows(rectifier: Rectifier, limit: int) -> Iterator[Window]:
            with closing(dataset.frames()) as frames:
                some = islice(frames, num_frames)
                keys = select_keyframes(some, config.windows, info.intrinsics, info.size)
                yield from cut_windows(islice(keys, limit), config.windows, rectifier.image)

        as_seen = Calibration(given, NO_DISTORTION, size, info.intrinsics_source)
        if config.calibration.keyframes:
            first = windows(Rectifier(as_seen, size), config.calibration.keyframes)
            as_seen = backbone.calibrate(first, given)
        self.rectifier = Rectifier(as_seen, size)
        self.num = 0
        for window in windows(self.rectifier, num_frames):
            prediction = backbone.predict(window.images, window.frames, self.rectifier.intrinsics)
            height, width = prediction.depth.shape[1:]
            colors = reduce_images(window.images, (height, width))
            self.files.save(self.num, prediction, colors)
            self.num += 1


def main(  # noqa: PLR0913, PLR0917  (one for each flag)
    data: Annotated[str, typer.Argument(help="demo, kitti or 7scenes")],
    folder: Annotated[Path | None, typer.Argument(help="where the data lies")] = None,
    sequence: Annotated[str, typer.Option(help="of KITTI")] = "00",
    backbone: Annotated[str, typer.Option(help="source of depth and poses")] = "simulated",
    rows: Annotated[str, typer.Option(help="names, with commas")] = DEFAULT_ROWS,
    assignments: Annotated[list[str] | None, typer.Option("--set", help="for all rows")] = None,
    num_frames: Annotated[int, typer.Option(help="frames to use, at most")] = 100_000,
    min_confidence: Annotated[float, typer.Option(help="of the pixels that count")] = 0.0,
) -> None:
    """Print the table."""
    unknown = [name for name in rows.split(",") if name.strip() not in ROWS]
    if unknown:
        raise typer.BadParameter(f"no row {', '.join(unknown)}; there is {', '.join(ROWS)}")
    try:
        dataset = _open(data, folder, sequence, assignments or [])
        table = Table("", "AbsRel", "δ<1.25", "mismatch", "ATE m", "layers reached")
        predicted: dict[str, Predictions] = {}
        with tempfile.TemporaryDirectory() as scratch:
            for name in (part.strip() for part in rows.split(",")):
                config = _config(ROWS[name], backbone, assignments or [])
                key = config.windows.model_dump_json()
                if key not in predicted:
                    place = Path(scratch) / str(len(predicted))
                    predicted[key] = Predictions(dataset, config, place, num_frames)
                result = _evaluate(predicted[key], dataset, config, min_confidence)
                table.add_row(name, *("-" if x is None else f"{x:.4f}" for x in result))
        Console(width=110).print(table)
    except LaserSlamError as error:
        typer.echo(f"ablate_lsa: {error}", err=True)
        raise typer.Exit(1) from error


def _config(row: Row, backbone: str, assignments: list[str]) -> Config:
    file = None if row.config is None else shipped_configs() / f"{row.config}.yaml"
    return load_config(None, file, [f"backbone.name={backbone}", *row.assignments, *assignments])


def _open(data: str, folder: Path | None, sequence: str, assignments: list[str]) -> Dataset:
    if data == "demo":
        from laser_slam.datasets.synthetic.drive import SyntheticDrive  # noqa: PLC0415  (Open3D)

        return SyntheticDrive(load_config(assignments=assignments).synthetic)
    if folder is None:
        raise typer.BadParameter("say where the data lies")
    if data == "7scenes":
        from laser_slam.datasets.seven_scenes import SevenScenes  # noqa: PLC0415

        return SevenScenes(folder)
    from laser_slam.datasets.kitti import KittiOdometry  # noqa: PLC0415

    return KittiOdometry(folder, sequence)


def _evaluate(
    predictions: Predictions, dataset: Dataset, config: Config, min_confidence: float
) -> Result:
    slam = Slam(config)
    layers: list[Layers | None] = []
    for index in range(predictions.num):
        slam.add(*predictions.files.load(index))
        layers.append(slam.layers)
    if config.smooths_layers:
        layers = _smoothed(predictions, slam, layers, config)
    errors = None
    if dataset.info.truth is not None:
        times_s = np.arange(100_000) / 10.0
        errors = evaluate_trajectory(slam.trajectory(times_s), dataset.info.truth)
    depths, truths, masks = [], [], []
    for node, its_layers in zip(slam.nodes, layers, strict=True):
        prediction, _ = predictions.files.load(node.index)
        if its_layers is not None:
            prediction = apply_layers(prediction, its_layers, config.layers)
        step = 1 + slam.num_keyframes * prediction.depth[0].size // MAX_PIXELS
        for i in np.flatnonzero(node.is_owned):
            truth = dataset.true_depth(int(node.frames[i]))
            if truth is None:
                continue
            truth = _nearest(predictions.rectifier.depth(truth), prediction.depth.shape[1:])
            depths.append(prediction.depth[i].ravel()[::step] * node.world_from_window.scale)
            truths.append(truth.ravel()[::step])
            masks.append(prediction.confidence[i].ravel()[::step] > min_confidence)
    depth = evaluate_depth(depths, truths, masks)
    counts = [node.layers for node in slam.nodes if node.layers is not None]
    after = [c.mismatch_after for c in counts if c.mismatch_after is not None]
    total = sum(c.layers for c in counts)
    return Result(
        depth.abs_rel,
        depth.delta_125,
        float(np.mean(after)) if after else None,
        None if errors is None else errors.ate_sim3_m.rmse if errors.ate_sim3_m else None,
        sum(c.reached for c in counts) / total if total else None,
    )


def _smoothed(
    predictions: Predictions, slam: Slam, layers: Sequence[Layers | None], config: Config
) -> list[Layers | None]:
    def backwards() -> Iterator[tuple[Prediction, Layers, float | None]]:
        for node, its_layers in zip(reversed(slam.nodes), reversed(layers), strict=True):
            assert its_layers is not None
            yield predictions.files.load(node.index)[0], its_layers, node.measured_scale

    smoothed: list[Layers | None] = list(smooth_layers(backwards(), config.layers))
    return smoothed[::-1]


def _nearest(image: Depth, size: tuple[int, ...]) -> Depth:
    out: Depth = cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT)
    return out


if __name__ == "__main__":
    typer.run(main)
