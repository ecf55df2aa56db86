"""The default descriptor: what binary corner features have left over from a small vocabulary."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from laser_slam.config import PlacesConfig
from laser_slam.types import Image

Array32 = NDArray[np.float32]

VOCABULARY = Path(__file__).with_name("vocabulary.npz")
FAST_THRESHOLD = 7  # grey levels; OpenCV's 20 leaves dim streets without corners


@dataclass(frozen=True)
class Vocabulary:
    """What features are compared with: learnt once, from generated streets.

    Attributes:
        mean: (256,) of the bits of all features.
        axes: (256, d) orthonormal directions along which they vary most.
        words: (k, d) centres of their clusters along these.
    """

    mean: Array32
    axes: Array32
    words: Array32

    @classmethod
    def load(cls, path: Path = VOCABULARY) -> Vocabulary:
        """Read a file that ``tools/learn_vocabulary.py`` wrote."""
        with np.load(path, allow_pickle=False) as file:
            return cls(*(file[name].astype(np.float32) for name in ("mean", "axes", "words")))


class VladDescriptor:
    """Sum up an image's ORB features, word by word, as offsets from the word.

    Reference: Jegou et al., CVPR 2010 (VLAD); Arandjelovic and Zisserman, CVPR 2013 (each word's
    sum has the same length, so that repeated structure does not drown the rest).
    Differs: ORB bits along their principal axes in place of SIFT, at a tenth of the time and with
    the same recall on our drives; the vocabulary is fixed, so that the first keyframe has a
    description at once and a run's result does not depend on where it started.
    """

    def __init__(self, config: PlacesConfig, vocabulary: Vocabulary | None = None) -> None:
        """Take the shipped vocabulary unless another is given."""
        self._width = config.width
        self._num_features = config.num_features
        self._vocabulary = vocabulary or Vocabulary.load()

    @property
    def size(self) -> int:
        """Return the length D of its vectors."""
        return int(self._vocabulary.words.size)

    def describe(self, image: Image) -> Array32:
        """Describe one (H, W, 3) RGB image as (D,) of unit length, or zeros without corners."""
        words = self._vocabulary.words
        features = (corner_bits(image, self._width, self._num_features) - self._vocabulary.mean) @ (
            self._vocabulary.axes
        )
        nearest = np.argmax(features @ words.T - 0.5 * (words**2).sum(axis=1), axis=1)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, features - words[nearest])
        out = _unit(_unit(sums).ravel())
        return np.asarray(out, np.float32)


def corner_bits(image: Image, width: int, num_features: int) -> Array32:
    """Return the (N, 256) bits, 0 or 1, of an image's ORB features.

    Args:
        image: (H, W, 3) RGB uint8.
        width: px; wider images are reduced to it.
        num_features: N at most.
    """
    grey = shrunken_grey(image, width)
    orb = cv2.ORB.create(nfeatures=num_features, fastThreshold=FAST_THRESHOLD)
    _, packed = orb.detectAndCompute(grey, None)
    if packed is None:
        return np.zeros((0, 256), np.float32)
    return np.unpackbits(packed, axis=1).astype(np.float32)


def shrunken_grey(image: Image, width: int) -> Image:
    """Return the (h, w) grey of an RGB image, no wider than ``width``."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if grey.shape[1] > width:
        size = (width, max(1, round(grey.shape[0] * width / grey.shape[1])))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(grey)


def _unit(vectors: Array32) -> Array32:
    """Scale (..., D) to unit length; zeros stay."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1))
