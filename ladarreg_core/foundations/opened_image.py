"""Image files opened by Pillow, with a limit of our own."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from PIL.Image import Image

MAX_PIXELS = 400_000_000
"""Pixels of the largest image that is opened; phones take pictures of 200 megapixels."""
_limit_lock = threading.Lock()


@contextmanager
def opened_image(source: Any, formats: Sequence[str]) -> Iterator[Image]:
    """Open an image file of up to `MAX_PIXELS`; its pixels are decoded when they are asked for.

    Args:
        source: a path or a binary stream.
        formats: names of Pillow's decoders that may be used.

    Raises:
        PIL.UnidentifiedImageError: if it is no such image.
        PIL.Image.DecompressionBombError: if it claims more pixels.
        OSError: if it cannot be read.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns about large images
        with _limit_lock:  # Pillow's limit is global to the process, and is restored for its other users
            before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, MAX_PIXELS // 2  # twice as many are refused
            try:
                image = Image.open(source, formats=list(formats))
            finally:
                Image.MAX_IMAGE_PIXELS = before
        with image:
            yield image
