"""Between laser and photograph: the model's picture as a mix of both."""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import ByteArray
from ladarreg_core.errors import OptionError
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture import RegisteredTexture, model_picture

_DARKEST, _BRIGHTEST = 18.0, 245.0
_PERCENTILES = (1.0, 99.0)
_GAMMA = 0.6  # raw intensity falls with the square of the range: most of it lies near the dark end


def intensity_picture(scan: Scan) -> ByteArray:
    """Return the scan's intensity, contrast stretched over its returns, as gray RGB, (H, W, 3) uint8."""
    low, high = np.percentile(scan.intensity[scan.valid], _PERCENTILES)
    share = np.clip((scan.intensity - np.float32(low)) / np.float32(max(high - low, 1e-12)), 0, 1)
    share = share**_GAMMA
    gray = np.rint(_DARKEST + share * (_BRIGHTEST - _DARKEST)).astype(np.uint8)
    gray[~scan.valid] = 0
    return np.repeat(gray[..., None], 3, axis=-1)


def blended_picture(scan: Scan, texture: RegisteredTexture, *, share: float) -> ByteArray:
    """Return the model's picture between the laser's intensity (`share` 0) and the photograph's colour (1).

    Args:
        scan: the scan.
        texture: the photograph on its grid.
        share: of the colour, 0 to 1.

    Returns:
        (H, W, 3) uint8 RGB; at 1 it is `model_picture`.

    Raises:
        OptionError: if the share is not between 0 and 1.
        ShapeError: if the texture is not on the scan's grid.
    """
    if not 0 <= share <= 1:
        raise OptionError(f"the share of colour is {share}; it must be between 0 and 1")
    colour = model_picture(scan, texture)
    if share == 1:
        return colour
    mixed = (1 - share) * intensity_picture(scan).astype(np.float32) + share * colour.astype(np.float32)
    return np.rint(mixed).astype(np.uint8)
