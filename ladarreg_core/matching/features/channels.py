"""Illumination-invariant orientation channels, comparable between laser and camera.

The channels of a pixel say how strongly an edge of each direction t responds: max(|gx cos t + gy sin t| - .83 m, 0)
with the gradient (gx, gy) and its magnitude m. This is a function of t modulo pi, so that it does not depend on the
sign of the contrast, and smooth: its mean and first two harmonics hold 97 % of its energy, with the third 99 %. These
five or seven numbers are kept, weighted so that their scalar products are those of the responses at all t. They are
computed from the gradient without trigonometry, and summed, blurred and divided like the responses themselves, of which
they are linear functions.
"""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.foundations.arrays import FloatArray

FEW_HARMONICS, ALL_HARMONICS = 2, 3
"""Harmonics beside the mean, for images full of edges, and for few edges whose directions must be distinguished."""
_PRE_BLUR_PX = 0.8
# Root energies of the three harmonics of max(|cos t| - .83, 0), relative to the mean's.
_FIRST, _SECOND, _THIRD = 1.2270, 0.7690, 0.2769
_STRIP_ROWS = 16
_MEDIAN_SAMPLES = 50_000  # the median of an image is known to half a per cent from so many
_MIN_FACTOR, _NOISE_FACTOR = 0.02, 1.0
_MIN_MAGNITUDE = 1e-6


def raw_channels(
    planes: list[FloatArray], *, harmonics: int = FEW_HARMONICS, pre_blur_px: float = _PRE_BLUR_PX
) -> FloatArray:
    """Return the summed channels of several gray planes.

    The channels of the planes are summed, not their gradients: that would be equivalent to a single gray image.

    Args:
        planes: images (H, W) of one size, in gray levels.
        harmonics: 2 or 3.
        pre_blur_px: Gaussian sigma before the gradients.

    Returns:
        (C, H, W) float32, C = 5 or 7: m, 1.23 m (cos 2 a, sin 2 a), .77 m (cos 4 a, sin 4 a) and .28 m (cos 6 a,
        sin 6 a), with the magnitude m and the direction a of the gradient.
    """
    height, width = planes[0].shape
    count = 1 + 2 * harmonics
    total = np.empty((count, height, width), np.float32)
    gradients = []
    for plane in planes:
        smooth = cv2.GaussianBlur(np.ascontiguousarray(plane, dtype=np.float32), (0, 0), pre_blur_px)
        gradients.append(
            [np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *order), dtype=np.float32) for order in ((1, 0), (0, 1))]
        )
    # Strip by strip, so that the passes run in the processor's cache. Sums and roots are NumPy's: OpenCV's differ
    # in the last digit with the alignment of the array in memory, and equal images must give equal poses.
    buffers = np.empty((count + 1, min(_STRIP_ROWS, height), width), np.float32)
    for top in range(0, height, _STRIP_ROWS):
        strip = total[:, top : top + _STRIP_ROWS]
        for number, gradient in enumerate(gradients):
            of_plane = buffers[:count, : strip.shape[1]] if number else strip
            _set_harmonics(of_plane, buffers[-1, : strip.shape[1]], *(g[top : top + _STRIP_ROWS] for g in gradient))
            if number:
                strip += of_plane
    return total


def _set_harmonics(channels: FloatArray, scale: FloatArray, gx: FloatArray, gy: FloatArray) -> None:
    """Set the channels (C, h, w) of a gradient (h, w) each; `scale` is overwritten."""
    magnitude, cosine, sine, cosine_2, sine_2, *third = channels
    np.multiply(gx, gx, out=cosine_2)
    np.multiply(gy, gy, out=sine_2)
    np.add(cosine_2, sine_2, out=magnitude)
    np.sqrt(magnitude, out=magnitude)
    np.maximum(magnitude, np.float32(_MIN_MAGNITUDE), out=scale)
    np.divide(np.float32(_FIRST), scale, out=scale)
    np.subtract(cosine_2, sine_2, out=cosine)
    cosine *= scale
    np.multiply(gx, gy, out=sine)
    sine *= scale
    sine += sine
    # Twice the angle once more: products of the first harmonic with itself.
    scale *= np.float32(_SECOND / _FIRST**3)
    np.multiply(cosine, cosine, out=cosine_2)
    np.multiply(sine, sine, out=sine_2)
    cosine_2 -= sine_2
    cosine_2 *= scale
    np.multiply(cosine, sine, out=sine_2)
    sine_2 *= scale
    sine_2 += sine_2
    if third:  # the sum of both angles
        scale *= np.float32(_THIRD * _FIRST / _SECOND**2)
        np.subtract(cosine * cosine_2, sine * sine_2, out=third[0])
        np.add(sine * cosine_2, cosine * sine_2, out=third[1])
        for channel in third:
            channel *= scale


def channel_scale(raw: FloatArray, *, blur_px: float = 1.5) -> tuple[float, float]:
    """Return the largest and the median strength of blurred channels (C, H, W), from which their floor follows."""
    norm = _norm(_blurred(raw, blur_px))
    largest = float(norm.max(initial=0.0))
    return (largest, _noise(norm)) if largest > 0 else (0.0, 0.0)


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
        raw: (C, H, W).
        blur_px: Gaussian sigma of the blur.
        local_px: Gaussian sigma of the neighbourhood for the local strength.
        local_factor: weight of the local strength in the divisor.
        least_floor: least value of median n + .02 max n, for one of several pictures that are compared together: the
            noise of an empty one must not be amplified either.
        overwrite: whether `raw` may be overwritten; fresh memory of this size costs as much time as the blur.

    Returns:
        (H, W, C) float32, C / (n + factor blur(n) + median n + .02 max n) with n the norm over the channels; its norm
        is below 1.
    """
    planes = _blurred(raw, blur_px, overwrite=overwrite)
    norm = _norm(planes)
    largest = float(norm.max(initial=0.0))
    if largest <= 0:
        return np.zeros((*norm.shape, len(planes)), np.float32)
    noise = _noise(norm)
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


def _noise(norm: FloatArray) -> float:
    """Return the median of the positive values of an image (H, W), of which at least one is, from a sample of them."""
    sample = norm.reshape(-1)[:: norm.size // _MEDIAN_SAMPLES | 1]  # an odd step visits all columns
    positive = sample[sample > 0]
    return float(np.median(positive if len(positive) else norm[norm > 0]))


def _broad_blur(image: FloatArray, sigma_px: float) -> FloatArray:
    """Blur with a broad Gaussian at a quarter of the resolution, which loses no detail at this width."""
    height, width = image.shape
    small = cv2.resize(image, (max(width // 4, 1), max(height // 4, 1)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_px / 4)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))


def channel_products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the scalar products (...) of channel vectors (..., C).

    They are summed in a stated order: that of a matrix product depends on the processor, and points are drawn by them.
    """
    products = first * second
    total: FloatArray = products[..., 0] + products[..., 1]
    for k in range(2, products.shape[-1]):
        total += products[..., k]
    return total


def add_channels(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the sum of two normalised channel images (H, W, C), with its norm limited to 1."""
    total = np.empty_like(first)
    for top in range(0, len(total), _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        strip = total[rows]
        np.add(first[rows], second[rows], out=strip)
        length = np.sqrt(np.maximum(channel_products(strip, strip), 1))
        strip *= np.repeat(1 / length, strip.shape[-1]).reshape(strip.shape)  # several times as fast as by broadcasting
    return total
