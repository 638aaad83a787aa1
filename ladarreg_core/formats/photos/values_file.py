"""Images of one channel whose pixels are values with a unit: counts, dose rates, temperatures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.begun_read import BegunRead
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, reading
from ladarreg_core.formats.photos.exif import orientation_of, upright
from ladarreg_core.formats.photos.image_file import read_image


def read_values(path: PathLike) -> NDArray[np.float32]:
    """Read an image of one channel, upright, its numbers as they stand in the file.

    Args:
        path: a TIFF of 8 or 16 bits or floating point, a gray PNG, or another gray image.

    Returns:
        (h, w) float32; NaN where the file says so.

    Raises:
        FormatError: if the file is no image, is damaged, or has colours that differ.
    """
    with BegunRead(_read, (Path(path),), {}) as read:
        return read.result()


def _read(path: Path) -> NDArray[np.float32]:
    with reading(path) as file:
        image = read_image(file, budget=ReadBudget.of(file.stat().st_size))
        values = upright(image.values, orientation_of(image.exif))
        if values.ndim == 3:
            if not (values == values[..., :1]).all():
                raise FormatError("it has colours, which are no values of a quantity; give an image of one channel")
            values = values[..., 0]
        return np.ascontiguousarray(values, dtype=np.float32)
