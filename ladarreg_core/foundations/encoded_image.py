"""Pictures in memory as the content of PNG and JPEG files."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ladarreg_core.foundations.arrays import ByteArray


def encoded_image(picture: ByteArray, extension: str, settings: Sequence[int] = ()) -> bytes:
    """Return a picture (H, W, 3), uint8 RGB, as the content of an image file.

    Args:
        picture: the picture.
        extension: `.png` or `.jpg`.
        settings: OpenCV's, as pairs of a name and a value. A PNG without any is written in a third of the time of level
            4, and is up to a seventh larger for a photograph, twice as large for a flat map.
    """
    done, encoded = cv2.imencode(extension, cv2.cvtColor(np.asarray(picture), cv2.COLOR_RGB2BGR), list(settings))
    assert done, "an 8-bit image can always be encoded"
    return encoded.tobytes()
