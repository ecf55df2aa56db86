"""Pictures as text inside the page, small enough for a phone."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import PIL.Image

_QUALITIES = (82, 65, 45)  # for photographs; the last one also for those that must shrink
_SHRINK = 0.75


@dataclass(frozen=True)
class Embedded:
    """A picture that is part of the page.

    Attributes:
        uri: the picture itself, as a data URI.
        width: in pixels.
        height: in pixels.
    """

    uri: str
    width: int
    height: int


def embed(path: Path, max_width: int, max_bytes: int) -> Embedded | None:
    """Read a picture, make it small, and turn it into text; None: there is none that can be read.

    Drawings of few colours stay exact; photographs lose what is hardly seen.

    Args:
        path: of a picture file.
        max_width: of the result, in pixels.
        max_bytes: of the result, before it becomes text.
    """
    try:
        with PIL.Image.open(path) as file:
            image = file.convert("RGB")
    except (OSError, ValueError, SyntaxError):  # damaged files make Pillow raise any of these
        return None
    if image.width > max_width:
        image = _resized(image, max_width)
    data = _compressed(image, max_bytes)
    while len(data) > max_bytes and image.width > 64:
        image = _resized(image, int(_SHRINK * image.width))
        data = _webp(image, quality=_QUALITIES[-1])
    text = base64.b64encode(data).decode("ascii")
    return Embedded(f"data:image/webp;base64,{text}", image.width, image.height)


def _resized(image: PIL.Image.Image, width: int) -> PIL.Image.Image:
    height = max(1, round(image.height * width / image.width))
    return image.resize((width, height), PIL.Image.Resampling.LANCZOS)


def _compressed(image: PIL.Image.Image, max_bytes: int) -> bytes:
    """Return the best quality that fits, or the smallest of those tried."""
    lossy = _webp(image, quality=_QUALITIES[0])
    if image.getcolors(4096) is not None:
        exact = _webp(image, lossless=True)
        if len(exact) <= min(max_bytes, 2 * len(lossy)):
            return exact
    for quality in _QUALITIES[1:]:
        if len(lossy) <= max_bytes:
            break
        lossy = _webp(image, quality=quality)
    return lossy


def _webp(image: PIL.Image.Image, *, quality: int = 75, lossless: bool = False) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=quality, lossless=lossless, method=4)
    return buffer.getvalue()
