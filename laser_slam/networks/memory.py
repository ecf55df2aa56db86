"""How much memory a window takes, and so how many frames fit; computed, for any device.

Attention is fused on CUDA devices and CPUs, so nothing there is quadratic in tokens: what is alive
at once is so many numbers a token while blocks work, and so many bytes a pixel of the frames that a
head takes at once. The numbers are those of the networks' own tensors, counted op by op
(tests/test_memory.py does so). Where PyTorch has no fused form, more is needed for long windows.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

NUM_SPECIAL = 5  # tokens of a frame beside those of its patches
PATCH_PX = 14
WIDEST = 4  # bytes of the heads' numbers
MARGIN = 1.15  # fragments and workspaces of the device's libraries
MOST_FRAMES = 2000  # that anybody asks for


@dataclass(frozen=True)
class Appetite:
    """What a network takes.

    Attributes:
        trunk_weights: number of those that the dtype is of.
        head_weights: number of those that stay float32.
        token: numbers alive per token of all frames while the blocks work, in the dtype.
        token_wide: bytes per token of all frames on top of it, whatever the dtype.
        kept: numbers per token of all frames that wait for the heads, in the dtype.
        pixel: bytes per pixel of all frames that the heads give back.
        head_token: numbers per token of the frames that a head takes at once, in the dtype.
        head_pixel: bytes per pixel of these frames.
        once: bytes per pixel of one frame, however many there are.
    """

    trunk_weights: int
    head_weights: int
    token: float
    token_wide: float
    kept: float
    pixel: float
    head_token: float
    head_pixel: float
    once: float


APPETITES = {
    "pi3": Appetite(955_785_728, 2_911_004, 13_185, 3_357, 2_048, 28, 16_384, 12, 0),
    "pi3x": Appetite(1_341_482_752, 18_549_681, 13_185, 3_357, 2_048, 37, 3_049, 693, 3),
    "vggt": Appetite(909_111_296, 248_829_172, 18_233, 3_348, 8_093, 17, 0, 1_615, 515),
}


@dataclass(frozen=True)
class Request:
    """What is asked of a network.

    Attributes:
        network: its name.
        size: (height, width) of the images, px.
        dtype: of all layers but the heads, as settings name it.
        chunk: frames that the heads take at once.
    """

    network: str
    size: tuple[int, int]
    dtype: str
    chunk: int = 8

    @property
    def _bytes(self) -> int:
        # float16 is float32 that layers cast: see ``Placement``
        return 2 if self.dtype == "bfloat16" else WIDEST

    def weights_bytes(self) -> int:
        """Return what the weights take."""
        appetite = APPETITES[self.network]
        return appetite.trunk_weights * self._bytes + appetite.head_weights * WIDEST

    def window_bytes(self, num_frames: int) -> float:
        """Return the most that a window of so many frames takes beside the weights."""
        appetite, pixels = APPETITES[self.network], self.size[0] * self.size[1]
        tokens = NUM_SPECIAL + pixels // PATCH_PX**2
        at_once = min(self.chunk, num_frames)
        blocks = tokens * (appetite.token * self._bytes + appetite.token_wide)
        waiting = tokens * appetite.kept * self._bytes + pixels * appetite.pixel
        head = tokens * appetite.head_token * self._bytes + pixels * appetite.head_pixel
        heads = num_frames * waiting + at_once * head + pixels * appetite.once
        return max(num_frames * blocks, heads)

    def largest_window(self, free_bytes: int, *, has_weights: bool = False) -> int:
        """Return how many frames fit in free memory; 0: not even one.

        Args:
            free_bytes: of the device.
            has_weights: the weights are on the device already, and not in ``free_bytes``.
        """
        left = free_bytes - (0 if has_weights else self.weights_bytes())
        low, high = 0, MOST_FRAMES
        while low < high:
            middle = (low + high + 1) // 2
            fits = self.window_bytes(middle) * MARGIN <= left
            low, high = (middle, high) if fits else (low, middle - 1)
        return low


def advise(request: Request, num_frames: int, free_bytes: int, section: str) -> str:
    """Say in one line what to do about a window that did not fit.

    Args:
        request: that was asked for.
        num_frames: of the window.
        free_bytes: that were there beside the weights.
        section: of the network's settings.
    """
    height, width = request.size
    # The count said that it fits where it is off; a quarter less is a good next try.
    fits = min(request.largest_window(free_bytes, has_weights=True), 3 * num_frames // 4)
    shrinks = min(fits / num_frames, 1.0) if fits else 0.25
    side = max(int(max(request.size) * sqrt(shrinks)) // PATCH_PX, 2) * PATCH_PX
    smaller = f"lower {section}.side to {side}"
    fewer = f"lower windows.size to {fits} (or auto), or " if fits > 3 else ""
    return (
        f"no memory for {num_frames} frames of {width}x{height}, about "
        f"{request.window_bytes(num_frames) / 1e9:.1f} GB of {free_bytes / 1e9:.1f} GB free: "
        f"{fewer}{smaller}"
    )
