"""Array types, and the conversion of outside data to read-only arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import ShapeError

FloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
IntArray = NDArray[np.integer[Any]]


def read_only(values: ArrayLike, dtype: Any, shape: tuple[int | None, ...], name: str) -> NDArray[Any]:
    """Return `values` as a contiguous read-only array of `dtype` and `shape`; the caller's array stays writable.

    An array that is read-only already, and has no other owner of its memory, is shared instead of copied: readers hand
    over large grids in this way.

    Args:
        values: anything array-like.
        dtype: the NumPy type required.
        shape: the shape required, with `None` for any length.
        name: the subject of the error's sentence.

    Raises:
        ShapeError: if the values are not numeric, would lose their meaning in `dtype`, or have another shape.
    """
    if type(values) is np.ndarray and values.dtype == dtype and values.flags.c_contiguous and _fits(values, shape):
        if not values.flags.writeable and values.base is None:
            return values
        array = values.copy()
        array.flags.writeable = False
        return array
    try:
        given = np.asarray(values)
        _check_conversion(given, np.dtype(dtype), name)
        with np.errstate(over="ignore"):  # too large for float32: infinite
            array = np.ascontiguousarray(values, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise ShapeError(f"{name} is not an array of numbers: {error}") from None
    if not _fits(array, shape):
        wanted = " x ".join("any" if want is None else str(want) for want in shape)
        found = " x ".join(map(str, array.shape)) or "a single number"
        raise ShapeError(f"{name} has the shape {found}; it must be {wanted}")
    shared = array is values and not array.flags.writeable and array.base is None
    if not shared and (array is values or array.base is not None):
        array = array.copy()
    array.flags.writeable = False
    return array


def _fits(array: NDArray[Any], shape: tuple[int | None, ...]) -> bool:
    if array.shape == shape:
        return True
    return array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))


def _check_conversion(given: NDArray[Any], wanted: np.dtype[Any], name: str) -> None:
    """Refuse complex numbers, and numbers that a conversion to integers would silently change."""
    if given.dtype.kind == "c":
        raise ShapeError(f"{name} contains complex numbers; it must contain real ones")
    if wanted.kind not in "iu" or given.dtype.kind not in "iuf" or np.can_cast(given.dtype, wanted):
        return
    low, high = np.iinfo(wanted).min, np.iinfo(wanted).max
    with np.errstate(invalid="ignore"):
        fits = (given >= low) & (given <= high) & (given == np.rint(given))
    if not fits.all():
        raise ShapeError(
            f"{name} contains {given[~fits].flat[0]:g}; it must contain whole numbers from {low} to {high}"
        )


def median(values: FloatArray) -> float:
    """Return the median of finite numbers (N,), N >= 1, as `np.median`, which takes five times as long for few."""
    middle = len(values) // 2
    ordered = np.partition(values, middle)
    upper = float(ordered[middle])
    return upper if len(values) % 2 else (float(ordered[:middle].max()) + upper) / 2
