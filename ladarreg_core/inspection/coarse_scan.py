"""A scan with as many cells as its texture is shown with, for what is computed from many photographs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.inspection.model_textures import small_picture, small_size
from ladarreg_core.scan import Scan


@dataclass(frozen=True, slots=True, eq=False)
class CoarseScan:
    """Every n-th row and column of a scan, and how a texture of them lies on the whole grid."""

    scan: Scan
    """Those rows and columns, from the middle one of the first n."""
    whole: tuple[int, int]
    """(H, W), cells of the scan."""
    stride: int
    """n."""

    @staticmethod
    def of(scan: Scan, longest_px: int, *, most_cells: float) -> CoarseScan:
        """Return as much of a scan as a texture shows.

        Args:
            scan: the scan.
            longest_px: longer side of the texture, which that of the cells does not fall below for its sake.
            most_cells: there are no more cells than this, unless fewer than 2 rows or columns would be left.
        """
        stride = max(int(max(scan.shape) / longest_px), int(np.ceil(np.sqrt(scan.ranges.size / most_cells))))
        stride = max(1, min(stride, min(scan.shape) // 2))
        part = slice((stride - 1) // 2, None, stride)
        try:
            return CoarseScan(scan if stride == 1 else scan.window(part, part), scan.shape, stride)
        except ShapeError:  # so few returns that none of them is among these cells
            return CoarseScan(scan, scan.shape, 1)

    def picture(self, image: ByteArray, longest_px: int, *, codes: bool = False) -> NDArray[np.uint8]:
        """Return a texture (h, w, 3) of this scan as one of the whole scan, at most `longest_px` wide and high.

        Args:
            image: (h, w, 3) on the cells of `scan`.
            longest_px: longer side at most.
            codes: whether its colours are codes, which must not be mixed.
        """
        if self.stride == 1:
            return small_picture(image, longest_px, codes=codes)
        width, height = small_size(self.whole, longest_px)
        first = (self.stride - 1) // 2
        to_cells = np.zeros((2, 3))
        for axis, (shown, side) in enumerate(((width, self.whole[1]), (height, self.whole[0]))):
            to_cells[axis, axis] = side / shown / self.stride
            to_cells[axis, 2] = (side / shown / 2 - 0.5 - first) / self.stride
        how = cv2.INTER_NEAREST if codes else cv2.INTER_LINEAR
        return np.array(
            cv2.warpAffine(
                np.asarray(image), to_cells, (width, height),
                flags=how | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
            ),
            dtype=np.uint8,
        )  # fmt: skip
