"""Memory limits of reading a file, checked against the file's claims before anything is allocated.

Compressed and constant data take almost no space: a few kilobytes can claim a scan or an image of gigabytes. Every
reader estimates its peak memory (arrays, copies and masks) from the header and checks it here first.
"""

from __future__ import annotations

from dataclasses import dataclass

from ladarreg_core.errors import FormatError, OptionError

DEFAULT_BYTES = 1 << 30
"""Default memory limit of an empty file."""
BYTES_PER_FILE_BYTE = 96
"""What each byte of a file adds to it: a dense scan takes 4 (LAZ) to 20 bytes per point in
the file, and 200 to 400 while it is gridded."""
ALWAYS_CELLS = 2_000_000
"""Grids of up to this many cells are accepted from files of any size: a scan may be nearly empty."""
MIN_CELLS = 4096
"""Smallest grid that a cloud is thinned to."""
CELLS_PER_BYTE = 2
"""Largest number of cells per byte of file for larger grids."""
ALWAYS_PIXELS = 16_000_000
"""Images of up to this many pixels are accepted from files of any size: an image may have a single colour."""
PIXELS_PER_BYTE = 200
"""Largest number of pixels per byte of file for larger images."""


@dataclass(frozen=True, slots=True)
class ReadBudget:
    """Limits of reading one file."""

    file_bytes: int
    """Size of the file, including the files that it refers to."""
    limit_bytes: int
    """Memory that the read may use at its peak."""

    @staticmethod
    def of(file_bytes: int, memory_bytes: int | None = None) -> ReadBudget:
        """Return the budget of a file.

        Args:
            file_bytes: file size, bytes.
            memory_bytes: memory that the read may use, bytes; None: 1 GB, and 96 bytes per byte of the file.

        Raises:
            OptionError: if `memory_bytes` is not positive.
        """
        if memory_bytes is None:
            memory_bytes = DEFAULT_BYTES + BYTES_PER_FILE_BYTE * file_bytes
        if isinstance(memory_bytes, bool) or not isinstance(memory_bytes, int) or memory_bytes < 1:
            raise OptionError(f"memory_bytes is {memory_bytes!r}; it must be a positive integer, in bytes")
        return ReadBudget(file_bytes, memory_bytes)

    @property
    def most_cells(self) -> int:
        """Number of cells that a file of this size can plausibly contain."""
        return max(ALWAYS_CELLS, CELLS_PER_BYTE * self.file_bytes)

    def cells_that_fit(self, bytes_per_cell: float, *, besides_bytes: float) -> int:
        """Return the number of cells that fit besides data of a given size; finer grids are thinned to it."""
        return max(MIN_CELLS, min(self.most_cells, int((self.limit_bytes - besides_bytes) / bytes_per_cell)))

    def require(self, needed_bytes: float, what: str) -> None:
        """Refuse a read that needs more memory than it may use.

        Args:
            needed_bytes: peak memory of the read, bytes.
            what: the data that need it, for the error message.

        Raises:
            FormatError: if it exceeds the budget.
        """
        if needed_bytes > self.limit_bytes:
            raise FormatError(
                f"{what} would need {_gigabytes(needed_bytes)} of memory, and a read of {self.file_bytes:,} bytes may "
                f"use {_gigabytes(self.limit_bytes)}; thin it out, split it or allow more (memory_bytes)"
            )

    def require_cells(self, rows: int, columns: int, bytes_per_cell: float) -> None:
        """Refuse a grid that is too large for memory, or for the file that claims it.

        Args:
            rows: rows of the grid, at least 1.
            columns: columns of the grid, at least 1.
            bytes_per_cell: peak memory of the read per cell, bytes.

        Raises:
            FormatError: if it exceeds the budget.
        """
        self.require(rows * columns * bytes_per_cell, f"its grid of {rows:,} x {columns:,} cells")
        if rows * columns > self.most_cells:
            raise FormatError(
                f"it claims {rows:,} x {columns:,} cells in {self.file_bytes:,} bytes; a file of that size contains at "
                f"most {self.most_cells:,}: it is damaged or nearly empty; thin it out"
            )

    def require_pixels(self, width: int, height: int, bytes_per_pixel: float) -> None:
        """Refuse an image that is too large for memory, or for the file that claims it.

        Args:
            width: image width, pixels.
            height: image height, pixels.
            bytes_per_pixel: peak memory of the read per pixel, bytes.

        Raises:
            FormatError: if it exceeds the budget.
        """
        pixels = width * height
        if pixels > ALWAYS_PIXELS and pixels > PIXELS_PER_BYTE * self.file_bytes:
            raise FormatError(
                f"the image claims {width:,} x {height:,} pixels in {self.file_bytes:,} bytes, more than "
                f"{PIXELS_PER_BYTE} per byte; it is truncated or malicious: export it again or scale it down"
            )
        self.require(pixels * bytes_per_pixel, f"the image of {width:,} x {height:,} pixels")


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:,.0f} GB" if count >= 1e11 else f"{count / 1e9:.3g} GB"
