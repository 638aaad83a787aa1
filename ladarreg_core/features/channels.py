"""Illumination-invariant orientation channels, comparable between laser and camera.

Eight rectified, locally normalised responses to edge direction, modulo pi, so that they do not depend on the sign of
the contrast.
"""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.arrays import FloatArray

ORIENTATIONS = 8
_PRE_BLUR_PX = 0.8
_SELECTIVITY = 0.83
_STRIP_ROWS = 16
_MEDIAN_SAMPLES, _MEDIAN_REACH = 4096, 150  # ranks in the sample: five standard deviations of the median's
_MIN_FACTOR, _NOISE_FACTOR = 0.02, 1.0
_ANGLES = np.arange(ORIENTATIONS) * np.pi / ORIENTATIONS
_COSINES, _SINES = np.cos(_ANGLES).astype(np.float32), np.sin(_ANGLES).astype(np.float32)


def raw_channels(planes: list[FloatArray], *, pre_blur_px: float = _PRE_BLUR_PX) -> FloatArray:
    """Return the summed rectified channels of several gray planes.

    The channels of the planes are summed, not their gradients: that would be equivalent to a single gray image.

    Args:
        planes: images (H, W) of one size, in gray levels.
        pre_blur_px: Gaussian sigma before the gradients.

    Returns:
        (8, H, W) float32: max(|gx cos t + gy sin t| - .83 m, 0) at t = k pi / 8, m the gradient's magnitude.
    """
    height, width = planes[0].shape
    total = np.empty((ORIENTATIONS, height, width), np.float32)
    gradients = []
    for plane in planes:
        smooth = cv2.GaussianBlur(np.ascontiguousarray(plane, dtype=np.float32), (0, 0), pre_blur_px)
        gradients.append(
            [np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *order), dtype=np.float32) for order in ((1, 0), (0, 1))]
        )
    # Strip by strip, so that the passes run in the processor's cache. Sums and roots are NumPy's: OpenCV's differ
    # in the last digit with the alignment of the array in memory, and equal images must give equal poses.
    buffers = np.empty((4, min(_STRIP_ROWS, height), width), np.float32)
    for top in range(0, height, _STRIP_ROWS):
        strip = total[:, top : top + _STRIP_ROWS]
        floor, by_u, by_v, response = buffers[:, : strip.shape[1]]
        for number, gradient in enumerate(gradients):
            gx, gy = (g[top : top + _STRIP_ROWS] for g in gradient)
            np.multiply(gx, gx, out=floor)
            np.multiply(gy, gy, out=by_v)
            floor += by_v
            np.sqrt(floor, out=floor)
            floor *= np.float32(_SELECTIVITY)
            np.abs(gx, out=response)  # its cosine is 1 and its sine 0
            _add_rectified(strip[0], response, floor, first=number == 0)
            for k in range(1, ORIENTATIONS // 2):
                np.multiply(gx, _COSINES[k], out=by_u)
                np.multiply(gy, _SINES[k], out=by_v)
                np.add(by_u, by_v, out=response)
                np.abs(response, out=response)
                _add_rectified(strip[k], response, floor, first=number == 0)
                # the orientation mirrored at the vertical has the same products
                np.subtract(by_v, by_u, out=response)
                np.abs(response, out=response)
                _add_rectified(strip[-k], response, floor, first=number == 0)
            np.multiply(gx, _COSINES[ORIENTATIONS // 2], out=response)  # not 0 in float32
            response += gy
            np.abs(response, out=response)
            _add_rectified(strip[ORIENTATIONS // 2], response, floor, first=number == 0)
    return total


def _add_rectified(total: FloatArray, response: FloatArray, floor: FloatArray, *, first: bool) -> None:
    """Add max(response - floor, 0) to the total, or set it; `response` is overwritten."""
    response -= floor
    if first:
        np.maximum(response, 0, out=total)
    else:
        np.maximum(response, 0, out=response)
        total += response


def channel_scale(raw: FloatArray, *, blur_px: float = 1.5) -> tuple[float, float]:
    """Return the largest and the median strength of blurred channels (8, H, W), from which their floor follows."""
    norm = _norm(_blurred(raw, blur_px))
    largest = float(norm.max(initial=0.0))
    return (largest, _median(norm[norm > 0])) if largest > 0 else (0.0, 0.0)


def channel_floor(largest: float, median: float) -> float:
    """Return what is added to the local strength of channels before they are divided by it."""
    return _MIN_FACTOR * largest + _NOISE_FACTOR * median


def normalised_channels(
    raw: FloatArray,
    *,
    blur_px: float = 1.5,
    local_px: float = 8.0,
    local_factor: float = 0.5,
    least_floor: float = 0.0,
    overwrite: bool = False,
) -> FloatArray:
    """Blur the channels and divide by their local strength, so that faint and strong edges have similar weight.

    The median strength of the image is added to the divisor: most pixels are not edges, so the median measures the
    noise, which must not be amplified to the strength of an edge. (Without it the speckle of a time-of-flight camera on
    flat walls outweighs the structure that it shares with the photo.)

    Args:
        raw: (8, H, W).
        blur_px: Gaussian sigma of the blur.
        local_px: Gaussian sigma of the neighbourhood for the local strength.
        local_factor: weight of the local strength in the divisor.
        least_floor: least value of median n + .02 max n, for one of several pictures that are compared together: the
            noise of an empty one must not be amplified either.
        overwrite: whether `raw` may be overwritten; fresh memory of this size costs as much time as the blur.

    Returns:
        (H, W, 8) float32, C / (n + factor blur(n) + median n + .02 max n) with n the norm over the channels; its norm
        is below 1.
    """
    planes = _blurred(raw, blur_px, overwrite=overwrite)
    norm = _norm(planes)
    largest = float(norm.max(initial=0.0))
    if largest <= 0:
        return np.zeros((*norm.shape, len(planes)), np.float32)
    noise = _median(norm[norm > 0])
    norm += np.float32(local_factor) * _broad_blur(norm, local_px)
    norm += np.float32(max(channel_floor(largest, noise), least_floor))
    for plane in planes:
        plane /= norm
    return np.asarray(cv2.merge(list(planes)), dtype=np.float32)


def _blurred(raw: FloatArray, blur_px: float, *, overwrite: bool = False) -> FloatArray:
    side = 2 * int(np.ceil(3 * blur_px)) - 1
    blurred = raw if overwrite else np.empty_like(raw)
    for plane, smooth in zip(raw, blurred, strict=True):
        cv2.GaussianBlur(plane, (side, side), blur_px, dst=smooth)
    return blurred


def _norm(planes: FloatArray) -> FloatArray:
    norm, square = np.zeros_like(planes[0]), np.empty_like(planes[0])
    for plane in planes:
        np.multiply(plane, plane, out=square)
        norm += square
    return np.asarray(np.sqrt(norm, out=norm))


def _median(values: FloatArray) -> float:
    """Return the median of many finite values (N,), as NumPy does, but by sorting only those near it."""
    count = len(values)
    sample = np.sort(values[:: count // _MEDIAN_SAMPLES | 1])  # an odd step visits all columns of an image
    middle = len(sample) // 2
    low, high = sample[max(middle - _MEDIAN_REACH, 0)], sample[min(middle + _MEDIAN_REACH, len(sample) - 1)]
    near = values[(values >= low) & (values <= high)]
    below = int(np.count_nonzero(values < low))
    first, last = (count - 1) // 2 - below, count // 2 - below
    if first < 0 or last >= len(near):  # the sample was not a fair one
        return float(np.median(values))
    return float(np.mean(np.partition(near, (first, last))[first : last + 1]))


def _broad_blur(image: FloatArray, sigma_px: float) -> FloatArray:
    """Blur with a broad Gaussian at a quarter of the resolution, which loses no detail at this width."""
    height, width = image.shape
    small = cv2.resize(image, (max(width // 4, 1), max(height // 4, 1)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_px / 4)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))


def channel_products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the scalar products (...) of channel vectors (..., 8), by a matrix product for speed."""
    return np.asarray((first * second) @ np.ones(ORIENTATIONS, first.dtype))


def add_channels(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the sum of two normalised channel images (H, W, 8), with its norm limited to 1."""
    total = first + second
    for top in range(0, len(total), _STRIP_ROWS):
        strip = total[top : top + _STRIP_ROWS]
        square = channel_products(strip, strip)
        longer = square > 1
        strip[longer] /= np.sqrt(square[longer])[:, None]
    return total
