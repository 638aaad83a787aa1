"""The memory that reading one file may use, compared with what the file claims before anything is allocated.

Compressed and constant data cost a file almost nothing: a few kilobytes can claim a scan or a picture of gigabytes.
Every reader works out from the header what it would hold at its peak (arrays, copies and masks) and asks here first.
"""

from __future__ import annotations

from dataclasses import dataclass

from ladarreg_core.errors import FormatError, OptionError

DEFAULT_BYTES = 1 << 30
"""Memory that reading a small file may use at its peak."""
BYTES_PER_FILE_BYTE = 64
"""A large file may use this many times its own size instead: a dense scan is 10 to 20 bytes a point in the file, and
about 400 while it is laid onto its grid."""
ALWAYS_CELLS = 2_000_000
"""A grid of up to this many cells is taken from a file of any size: a scan may be nearly empty."""
LEAST_CELLS = 4096
"""A cloud is not thinned to fewer."""
CELLS_PER_BYTE = 2
"""A larger grid needs at least half a byte of file for each of its cells."""
ALWAYS_PIXELS = 16_000_000
"""A picture of up to this many pixels is taken from a file of any size: it may be of one colour."""
PIXELS_PER_BYTE = 200
"""A larger picture may have this many pixels for each byte of its file."""


@dataclass(frozen=True, slots=True)
class ReadBudget:
    """What reading one file may cost."""

    file_bytes: int
    """Size of the file, with those that it refers to."""
    limit_bytes: int
    """Memory that the read may use at its peak."""

    @staticmethod
    def of(file_bytes: int, memory_bytes: int | None = None) -> ReadBudget:
        """Return the budget of a file.

        Args:
            file_bytes: its size, bytes.
            memory_bytes: memory that the read may use; None: 1 GB, or 64 times the file's size if that is more.

        Raises:
            OptionError: if `memory_bytes` is not positive.
        """
        if memory_bytes is None:
            memory_bytes = max(DEFAULT_BYTES, BYTES_PER_FILE_BYTE * file_bytes)
        if isinstance(memory_bytes, bool) or not isinstance(memory_bytes, int) or memory_bytes < 1:
            raise OptionError(f"memory_bytes is {memory_bytes!r}; it must be a positive whole number of bytes")
        return ReadBudget(file_bytes, memory_bytes)

    @property
    def most_cells(self) -> int:
        """The largest grid that a file of this size plausibly holds."""
        return max(ALWAYS_CELLS, CELLS_PER_BYTE * self.file_bytes)

    def cells_beside(self, held_bytes: float, bytes_per_cell: float) -> int:
        """Return the largest grid that there is room for beside what is held already; a finer one is thinned to it."""
        return max(LEAST_CELLS, min(self.most_cells, int((self.limit_bytes - held_bytes) / bytes_per_cell)))

    def require(self, needed_bytes: float, what: str) -> None:
        """Refuse a read that needs more memory than it may use.

        Args:
            needed_bytes: memory at the peak of the read, bytes.
            what: what needs it, in the plural or the singular, for the error.

        Raises:
            FormatError: if it is beyond the budget.
        """
        if needed_bytes > self.limit_bytes:
            raise FormatError(
                f"{what} would need {_gigabytes(needed_bytes)} of memory, and a read of {self.file_bytes:,} bytes may "
                f"use {_gigabytes(self.limit_bytes)}; thin it out, split it or allow more (memory_bytes)"
            )

    def require_cells(self, rows: int, columns: int, bytes_per_cell: float) -> None:
        """Refuse a grid that is too large for memory, or for the file that claims it.

        Args:
            rows: of the grid, at least 1.
            columns: of the grid, at least 1.
            bytes_per_cell: memory for each cell at the peak of the read, bytes.

        Raises:
            FormatError: if it is beyond the budget.
        """
        self.require(rows * columns * bytes_per_cell, f"its grid of {rows:,} x {columns:,} cells")
        if rows * columns > self.most_cells:
            raise FormatError(
                f"it claims {rows:,} x {columns:,} cells in {self.file_bytes:,} bytes; a file of that size holds at "
                f"most {self.most_cells:,}: it is damaged or nearly empty, so thin it out"
            )

    def require_pixels(self, width: int, height: int, bytes_per_pixel: float) -> None:
        """Refuse a picture that is too large for memory, or for the file that claims it.

        Args:
            width: of the picture, pixels.
            height: of the picture, pixels.
            bytes_per_pixel: memory for each pixel at the peak of the read, bytes.

        Raises:
            FormatError: if it is beyond the budget.
        """
        pixels = width * height
        if pixels > ALWAYS_PIXELS and pixels > PIXELS_PER_BYTE * self.file_bytes:
            raise FormatError(
                f"the picture claims {width:,} x {height:,} pixels in {self.file_bytes:,} bytes, more than "
                f"{PIXELS_PER_BYTE} a byte; it is cut off or no honest file: export it again or scale it down"
            )
        self.require(pixels * bytes_per_pixel, f"the picture of {width:,} x {height:,} pixels")


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:,.0f} GB" if count >= 1e11 else f"{count / 1e9:.3g} GB"
