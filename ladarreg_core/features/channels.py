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
_STRIP_ROWS = 48
_MIN_FACTOR, _NOISE_FACTOR = 0.02, 1.0
_ANGLES = np.arange(ORIENTATIONS) * np.pi / ORIENTATIONS


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
    total = np.zeros((ORIENTATIONS, height, width), np.float32)
    for plane in planes:
        smooth = cv2.GaussianBlur(np.ascontiguousarray(plane, dtype=np.float32), (0, 0), pre_blur_px)
        gradient = [np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *order), dtype=np.float32) for order in ((1, 0), (0, 1))]
        # Strip by strip, so that the passes run in the processor's cache. Sums and roots are NumPy's: OpenCV's differ
        # in the last digit with the alignment of the array in memory, and equal images must give equal poses.
        for top in range(0, height, _STRIP_ROWS):
            gx, gy = (g[top : top + _STRIP_ROWS] for g in gradient)
            floor = np.sqrt(gx * gx + gy * gy)
            floor *= np.float32(_SELECTIVITY)
            response, part = np.empty_like(gx), np.empty_like(gx)
            for k, angle in enumerate(_ANGLES):
                np.multiply(gx, np.float32(np.cos(angle)), out=response)
                np.multiply(gy, np.float32(np.sin(angle)), out=part)
                response += part
                np.abs(response, out=response)
                response -= floor
                np.maximum(response, 0, out=response)
                total[k, top : top + _STRIP_ROWS] += response
    return total


def channel_scale(raw: FloatArray, *, blur_px: float = 1.5) -> tuple[float, float]:
    """Return the largest and the median strength of blurred channels (8, H, W), from which their floor follows."""
    norm = _norm(_blurred(raw, blur_px))
    largest = float(norm.max(initial=0.0))
    return (largest, float(np.median(norm[norm > 0]))) if largest > 0 else (0.0, 0.0)


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

    Returns:
        (H, W, 8) float32, C / (n + factor blur(n) + median n + .02 max n) with n the norm over the channels; its norm
        is below 1.
    """
    planes = _blurred(raw, blur_px)
    norm = _norm(planes)
    largest = float(norm.max(initial=0.0))
    if largest <= 0:
        return np.zeros((*norm.shape, len(planes)), np.float32)
    noise = float(np.median(norm[norm > 0]))
    norm += np.float32(local_factor) * _broad_blur(norm, local_px)
    norm += np.float32(max(channel_floor(largest, noise), least_floor))
    for plane in planes:
        plane /= norm
    return np.asarray(cv2.merge(planes), dtype=np.float32)


def _blurred(raw: FloatArray, blur_px: float) -> list[FloatArray]:
    side = 2 * int(np.ceil(3 * blur_px)) - 1
    return [np.asarray(cv2.GaussianBlur(plane, (side, side), blur_px), dtype=np.float32) for plane in raw]


def _norm(planes: list[FloatArray]) -> FloatArray:
    norm = np.zeros_like(planes[0])
    for plane in planes:
        norm += plane * plane
    return np.asarray(np.sqrt(norm, out=norm))


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
    square = channel_products(total, total)
    longer = square > 1
    total[longer] /= np.sqrt(square[longer])[:, None]
    return total
