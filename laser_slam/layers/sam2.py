"""Layers from the masks of SAM 2, where a user has it installed.

SAM 2 is no dependency: neither its code nor its weights come with this package, and the tests hold
the adapter to a stand-in with the interface of SAM 2 and 2.1 (``build_sam2``,
``SAM2AutomaticMaskGenerator``), never to the network itself.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from laser_slam.config import SegmentationConfig
from laser_slam.errors import ConfigError, DependencyError
from laser_slam.layers.segmenters import close_gaps, known_cells, read_at_cells
from laser_slam.types import Image, Prediction


class Sam2Segmenter:
    """Let SAM 2 find masks in the colours; what no mask covers is one layer more."""

    def __init__(self, config: SegmentationConfig) -> None:
        """Load the network, to the GPU where there is one.

        Raises:
            ConfigError: the checkpoint is not set or not there, or does not fit its settings.
            DependencyError: SAM 2 is not installed.
        """
        self._downscale = config.downscale
        self._generator = _load(config.sam2_config, config.sam2_checkpoint)

    def segment(self, window: Prediction, colors: Image) -> NDArray[np.uint16]:
        """Label the frames by their colours; see ``Segmenter``."""
        size = (window.depth.shape[1], window.depth.shape[2])
        known = known_cells(window, self._downscale)
        out = np.zeros(known.shape, np.uint16)
        for index, image in enumerate(colors):
            masks = [record["segmentation"] for record in self._generator.generate(image)]
            cells = read_at_cells(stack_masks(masks, size), size, self._downscale)
            out[index] = close_gaps(np.where(known[index], cells, 0))
        return out


def stack_masks(masks: list[NDArray[np.bool_]], size: tuple[int, int]) -> NDArray[np.int32]:
    """Paint (H, W) masks over each other, the smallest on top.

    Returns:
        (H, W) labels: 1 where there is no mask, from 2 the masks from large to small.
    """
    labels = np.ones(size, np.int32)
    areas = [int(np.count_nonzero(mask)) for mask in masks]
    for label, index in enumerate(np.argsort(areas, kind="stable")[::-1], start=2):
        labels[np.asarray(masks[index], dtype=bool)] = label
    return labels


def _load(model_config: str, checkpoint: str) -> Any:
    if not checkpoint or not Path(checkpoint).expanduser().is_file():
        given = f"no file '{checkpoint}'" if checkpoint else "not set"
        raise ConfigError(
            f"layers.segmentation.sam2_checkpoint: {given}; get the weights from "
            "https://github.com/facebookresearch/sam2 and give their path"
        )
    try:
        build = import_module("sam2.build_sam").build_sam2
        generator = import_module("sam2.automatic_mask_generator").SAM2AutomaticMaskGenerator
        has_gpu = import_module("torch").cuda.is_available()
    except ImportError as error:
        raise DependencyError(
            f"the segmenter 'sam2' needs SAM 2 ({error}); install it with "
            "pip install git+https://github.com/facebookresearch/sam2, or set "
            "layers.segmentation.segmenter to felzenszwalb"
        ) from error
    device = "cuda" if has_gpu else "cpu"
    try:
        path = str(Path(checkpoint).expanduser())
        # Its post-processing is for prompted masks; the authors' own example leaves it off here.
        model = build(model_config, path, device=device, apply_postprocessing=False)
    except Exception as error:  # hydra, torch and SAM 2 raise their own kinds
        raise ConfigError(
            f"SAM 2 does not load {checkpoint} with layers.segmentation.sam2_config "
            f"'{model_config}': {error}"
        ) from error
    return generator(model)
