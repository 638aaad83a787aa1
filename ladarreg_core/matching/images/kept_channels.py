"""Channels of scans and photographs, kept for further registrations: the last view, and `Channels` by content."""

from __future__ import annotations

import hashlib
import weakref
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from threading import RLock
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.foundations.version import VERSION
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.photo_levels import LEVELS, PhotoLevels, photo_levels
from ladarreg_core.matching.images.scan_levels import ChannelSet, ScanLevels
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_window import grid_rays
from ladarreg_core.storage.checksums import checksum
from ladarreg_core.surface.perspective import View

Arrays = Mapping[str, NDArray[Any]]
_LARGEST_SCAN = 4_000_000  # cells; of larger scans the part in view is compared, and making it takes most of the time
_MAX_BYTES = 1_000_000_000
_FINE = "fine channels"  # as `ScanLevels.once` names them
_SHARED = ("channels", "_near_returns", "made")


class Channels:
    """Channels of scans and photographs: given to several calls of `register`, what one has made serves the others.

    The results are the same, bit for bit. A scan has an entry for each view that was compared, with its camera,
    direction and channels; a photograph has one for each resolution. Their keys are SHA-256 of the content, so that
    data that were read again find what was made of them. It holds the scans that were given to it. Of scans of more
    than 4 million cells, and of photographs of wide cameras, nothing is kept. It may be used in several threads.

    Args:
        most_bytes: memory of the arrays that are kept; the entries that were not used for longest are dropped. A
            photograph of 1 megapixel and a view of a scan for it take some 100 MB each.

    Raises:
        OptionError: if `most_bytes` is no whole number, or negative.
    """

    def __init__(self, *, most_bytes: int = _MAX_BYTES) -> None:
        require_int(most_bytes, "the memory of channels", least=0)
        self._most_bytes = most_bytes
        self._entries: OrderedDict[str, PhotoLevels | ScanLevels | Arrays] = OrderedDict()
        self._lock = RLock()

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of all entries, 64 hexadecimal digits each; the one that was used last is the last one."""
        with self._lock:
            return tuple(self._entries)

    def arrays(self, key: str) -> dict[str, NDArray[Any]]:
        """Return an entry as plain arrays, by name, without objects, as `np.savez` takes.

        What was made of the channels, such as the descriptors of corners, is not among them, but made again.

        Raises:
            KeyError: if there is no such entry.
        """
        with self._lock:
            return _arrays_of(self._entries[key])

    def add(self, key: str, arrays: Arrays) -> None:
        """Add an entry that `arrays` returned, e.g. in an earlier run; it is used for the content of its key.

        The arrays are trusted: of others than those of the key, results would be wrong.

        Raises:
            ShapeError: if an array is missing, or is none of an entry.
        """
        held = {name: np.asarray(array) for name, array in arrays.items()}
        needed = _PHOTO_ARRAYS if "planes 0.0" in held else _SCAN_ARRAYS
        absent = sorted(needed - set(held))
        if absent or any(array.dtype.kind not in "bfi" for array in held.values()):
            raise ShapeError(f"the arrays are none of channels: {', '.join(absent[:3]) or 'objects'!r} cannot be used")
        self._put(key, held)

    def photo_levels(self, photo: Photo, working: Camera, *, harmonics: int) -> PhotoLevels:
        """Return the levels of a photograph, made or kept; the arguments are those of `pyramid.photo_levels`."""
        key = photo_key(photo, working, harmonics=harmonics)
        with self._lock:
            found = self._entries.get(key)
            if found is None:
                levels = photo_levels(photo, working, harmonics=harmonics)
            elif isinstance(found, PhotoLevels):
                levels = found
            else:
                levels = _photo_of(found, photo.pinhole, working, harmonics)  # type: ignore[arg-type]
            self._put(key, levels)
        return levels

    def view(
        self, scan: Scan, camera: Camera, direction: Rigid, channel_set: ChannelSet, *, coarse: bool, harmonics: int
    ) -> ScanLevels | None:
        """Return the levels of a view of a scan that were kept; None if there are none.

        Args:
            scan: the scan.
            camera: the ideal camera that the view would be made for.
            direction: the rotation (view from scanner).
            channel_set: the channels to compare.
            coarse: whether the scan is coarse.
            harmonics: of the channels.
        """
        if scan.ranges.size > _LARGEST_SCAN:
            return None
        key = view_key(scan, camera, direction, channel_set, coarse=coarse, harmonics=harmonics)
        with self._lock:
            found = self._entries.get(key)
            if found is None:
                return None
            if isinstance(found, ScanLevels):
                levels = found if found.view.scan is scan else _of_scan(found, scan)
            else:
                levels = _view_of(found, scan, direction, channel_set, coarse, harmonics)  # type: ignore[arg-type]
            self._put(key, levels)
        return levels

    def keep_view(self, scan: Scan, camera: Camera, direction: Rigid, levels: ScanLevels) -> None:
        """Keep the levels of a view of a scan, with what has been and will be made of them; arguments as of `view`."""
        if levels.view.scan is scan and scan.ranges.size <= _LARGEST_SCAN:
            key = view_key(
                scan, camera, direction, levels.channel_set, coarse=levels.coarse, harmonics=levels.harmonics
            )  # fmt: skip
            self._put(key, _of_scan(levels, scan))  # without what only the making needed

    def _put(self, key: str, entry: PhotoLevels | ScanLevels | Arrays) -> None:
        with self._lock:
            self._entries[key] = entry
            self._entries.move_to_end(key)
            sizes = {name: _bytes_of(kept) for name, kept in self._entries.items()}
            total = sum(sizes.values())
            while total > self._most_bytes and self._entries:
                total -= sizes[self._entries.popitem(last=False)[0]]


def photo_key(photo: Photo, working: Camera, *, harmonics: int) -> str:
    """Return the key of a photograph's channels: SHA-256 of its pixels, its camera, and how the channels are made.

    Args:
        photo: the photograph, of a pinhole camera.
        working: the ideal camera of the comparison.
        harmonics: of the channels.
    """
    heat = photo.temperature_k
    return _key(
        kind="photo",
        pixels=_digest(photo.pixels),
        temperature="" if heat is None else _digest(heat),
        camera=photo.pinhole.as_fields(),
        working=working.as_fields(),
        harmonics=harmonics,
    )


def view_key(
    scan: Scan, camera: Camera, direction: Rigid, channel_set: ChannelSet, *, coarse: bool, harmonics: int
) -> str:
    """Return the key of a view's channels: SHA-256 of ranges, intensity and rays, and how the channels are made.

    Args:
        scan: the scan.
        camera: the ideal camera of the view.
        direction: the rotation (view from scanner).
        channel_set: the channels to compare.
        coarse: whether the scan is coarse.
        harmonics: of the channels.
    """
    return _key(
        kind="scan",
        ranges=_digest(scan.ranges),
        intensity=_digest(scan.intensity),
        intensity_is=scan.intensity_is,
        rays=_rays_digest(scan),
        camera=camera.as_fields(),
        direction=direction.rotation.tolist(),
        channel_set=channel_set,
        coarse=coarse,
        harmonics=harmonics,
    )


def _key(**fields: Any) -> str:
    return checksum({"software": [VERSION, np.__version__, cv2.__version__], **fields})


_digests: dict[int, tuple[weakref.ref[NDArray[Any]], str]] = {}
_rays_digests: WeakKeyDictionary[Scan, str] = WeakKeyDictionary()


def _digest(array: NDArray[Any]) -> str:
    """Return the SHA-256 of an array with its type and shape, of a read-only one from the first time."""
    known = _digests.get(id(array))
    if known is not None and known[0]() is array:
        return known[1]
    head = f"{array.dtype.str} {array.shape} ".encode()
    found = hashlib.sha256(head)
    found.update(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data)
    if not array.flags.writeable and array.base is None:
        number, digests = id(array), _digests
        _digests[number] = weakref.ref(array, lambda _: digests.pop(number, None)), found.hexdigest()
    return found.hexdigest()


def _rays_digest(scan: Scan) -> str:
    """Return the SHA-256 of the kind of a scan's grid and of its rays."""
    if scan not in _rays_digests:
        rays = grid_rays(scan.geometry, slice(None), slice(None))
        _rays_digests[scan] = f"{type(scan.geometry).__name__} {_digest(np.asarray(rays))}"
    return _rays_digests[scan]


_PHOTO_ARRAYS = {f"{name} {L}" for name in ("usable", "channels") for L in LEVELS} | {f"planes {L}.0" for L in LEVELS}
_SCAN_ARRAYS = {f"{name} {L}" for name in ("gray", "channels") for L in LEVELS} | {
    "view intensity", "view cells", "smooth ranges", "ranges", "edge", "block_px", "view camera",
}  # fmt: skip


def _bytes_of(value: object) -> int:
    """Return the memory of the arrays that an entry holds already."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, PhotoLevels | ScanLevels | View):
        return sum(_bytes_of(held) for held in list(vars(value).values()))
    if isinstance(value, Mapping):
        return sum(map(_bytes_of, list(value.values())))
    return sum(map(_bytes_of, value)) if isinstance(value, tuple | list) else 0


def _arrays_of(entry: PhotoLevels | ScanLevels | Arrays) -> dict[str, NDArray[Any]]:
    found: dict[str, NDArray[Any]]
    if isinstance(entry, PhotoLevels):
        found = {f"planes {L}.{k}": plane for L in LEVELS for k, plane in enumerate(entry.planes[L])}
        found |= {f"usable {L}": entry.usable[L] for L in LEVELS} | {f"channels {L}": entry.channels[L] for L in LEVELS}
        return found | ({_FINE: entry.fine_channels} if "fine_channels" in vars(entry) else {})
    if isinstance(entry, ScanLevels):
        found = {f"gray {L}": entry.gray_planes[L] for L in LEVELS}
        found |= {f"channels {L}": entry.channels[L] for L in LEVELS}
        found |= {"view intensity": entry.view.intensity, "view cells": entry.view.cells}
        found |= {"smooth ranges": entry.smooth_ranges, "ranges": entry.ranges, "edge": entry.edge}
        found["block_px"] = np.array(entry.block_px, np.int64)
        c = entry.view.camera  # not that of the photograph, whose principal point may be elsewhere
        found["view camera"] = np.array([c.width, c.height, c.fx, c.fy, c.cx, c.cy], np.float64)
        found |= {} if entry.structured is None else {"structured": entry.structured}
        return found | ({_FINE: entry.made[_FINE]} if _FINE in entry.made else {})
    return dict(entry)


def _photo_of(arrays: Arrays, source: Camera, working: Camera, harmonics: int) -> PhotoLevels:
    kinds = sum(name.startswith("planes 0.") for name in arrays)
    levels = PhotoLevels(
        source,
        (working, *(working.scaled(0.5**level) for level in LEVELS[1:])),
        tuple([arrays[f"planes {L}.{k}"] for k in range(kinds)] for L in LEVELS),
        tuple(arrays[f"usable {L}"] for L in LEVELS),
        harmonics,
    )
    vars(levels)["channels"] = tuple(arrays[f"channels {L}"] for L in LEVELS)
    if _FINE in arrays:
        vars(levels)["fine_channels"] = arrays[_FINE]
    return levels


def _view_of(
    arrays: Arrays, scan: Scan, direction: Rigid, channel_set: ChannelSet, coarse: bool, harmonics: int
) -> ScanLevels:
    width, height, *intrinsics = arrays["view camera"].tolist()
    camera = Camera(int(width), int(height), *intrinsics)
    levels = ScanLevels(
        View(scan, camera, direction, arrays["view intensity"], arrays["view cells"]),
        (camera, *(camera.scaled(0.5**level) for level in LEVELS[1:])),
        tuple(arrays[f"gray {L}"] for L in LEVELS),
        arrays["smooth ranges"],
        arrays["ranges"],
        arrays["edge"],
        channel_set,
        arrays.get("structured"),
        coarse=coarse,
        block_px=int(arrays["block_px"]),
        harmonics=harmonics,
    )
    vars(levels)["channels"] = tuple(arrays[f"channels {L}"] for L in LEVELS)
    if _FINE in arrays:
        levels.made[_FINE] = arrays[_FINE]
    return levels


@dataclass(frozen=True, slots=True, eq=False)
class _LastView:
    """The view that was compared last, for the next photograph of the same camera on the same scan object."""

    scan: weakref.ref[Scan]
    camera: Camera
    direction: Rigid
    levels: ScanLevels
    """Without the scan, which nothing keeps alive."""


_last: list[_LastView] = []  # one at most: a view for a photograph of 1 megapixel takes 80 MB


def recall_view(
    channels: Channels | None,
    scan: Scan,
    camera: Camera,
    direction: Rigid,
    channel_set: ChannelSet,
    *,
    coarse: bool,
    harmonics: int,
) -> ScanLevels | None:
    """Return the levels of a view, from the last one of the process or from channels; None if neither has them.

    A scan is read-only, so that of the last view the same object has the same content; channels compare the content.
    The arguments are those of `Channels.view`.
    """
    wanted = (channel_set, coarse, harmonics)
    for last in _last[:]:
        levels = last.levels
        if (
            last.scan() is scan
            and last.camera == camera
            and (last.direction.rotation == direction.rotation).all()
            and (levels.channel_set, levels.coarse, levels.harmonics) == wanted
        ):
            return _of_scan(levels, scan)
    if channels is None:
        return None
    return channels.view(scan, camera, direction, channel_set, coarse=coarse, harmonics=harmonics)


def keep_view(channels: Channels | None, scan: Scan, camera: Camera, direction: Rigid, levels: ScanLevels) -> None:
    """Keep the levels of a view in place of the last one, and in channels; of a large scan nothing is kept."""
    if levels.view.scan is not scan or scan.ranges.size > _LARGEST_SCAN:
        return
    views = _last

    def dropped(_: object) -> None:
        # It holds neither the view, which would keep it alive, nor globals, which may be gone at exit.
        views[:] = [view for view in views if view.scan() is not None]

    _last[:] = [_LastView(weakref.ref(scan, dropped), camera, direction, _of_scan(levels, None))]
    if channels is not None:
        channels.keep_view(scan, camera, direction, levels)


def forget_last_view() -> None:
    """Free the view that is kept for the next photograph."""
    _last.clear()


def _of_scan(levels: ScanLevels, scan: Scan | None) -> ScanLevels:
    """Return the same levels as those of another scan of the same content, or of none to be kept without it."""
    _ = levels.made  # what is made later is shared, too
    other = replace(levels, view=replace(levels.view, scan=scan))  # type: ignore[arg-type]
    vars(other).update({name: vars(levels)[name] for name in _SHARED if name in vars(levels)})
    return other
