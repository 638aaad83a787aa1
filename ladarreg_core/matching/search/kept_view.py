"""The last view of a scan that a photo was compared with, kept for further photos of the same camera on that scan."""

from __future__ import annotations

import weakref
from dataclasses import fields
from typing import Any

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.pyramid import ChannelSet, ScanLevels
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View

_LARGEST_SCAN = 4_000_000  # cells; of larger scans the memory matters more than the time
_SHARED = ("channels", "_near_returns", "made")


class _KeptView:
    """One view: its levels, without the scan itself, which is let go of as soon as nobody else holds it."""

    def __init__(self, scan: Scan, camera: Camera, direction: Rigid, levels: ScanLevels) -> None:
        _ = levels.made  # what is made later is shared, too
        self._camera, self._direction = camera, direction
        views = _last

        def let_go(_: object) -> None:
            # It holds neither this view, which would keep it alive, nor globals, which may be gone at exit.
            views[:] = [view for view in views if view._scan() is not None]

        self._scan = weakref.ref(scan, let_go)
        self._view = {f.name: getattr(levels.view, f.name) for f in fields(View) if f.name != "scan"}
        self._levels = {f.name: getattr(levels, f.name) for f in fields(ScanLevels) if f.name != "view"}
        self._shared = {name: vars(levels)[name] for name in _SHARED if name in vars(levels)}

    def levels(
        self, scan: Scan, camera: Camera, direction: Rigid, channel_set: ChannelSet, *, coarse: bool, harmonics: int
    ) -> ScanLevels | None:
        known: dict[str, Any] = self._levels
        asked = {"channel_set": channel_set, "coarse": coarse, "harmonics": harmonics}
        if self._scan() is not scan or any(known[name] != value for name, value in asked.items()):
            return None
        if self._camera != camera or (self._direction.rotation != direction.rotation).any():
            return None
        levels = ScanLevels(View(scan=scan, **self._view), **known)
        vars(levels).update(self._shared)
        return levels


_last: list[_KeptView] = []  # one at most: a view of a photo of 1 Mpixel takes 80 MB


def keep(scan: Scan, camera: Camera, direction: Rigid, levels: ScanLevels) -> None:
    """Keep the levels of a view with their channels, in place of those kept before; of a large scan nothing is kept.

    Args:
        scan: the scan.
        camera: the camera that the view was made for.
        direction: the rotation (view from scanner).
        levels: the levels.
    """
    if scan.ranges.size <= _LARGEST_SCAN and levels.view.scan is scan:
        _last[:] = [_KeptView(scan, camera, direction, levels)]


def recall(
    scan: Scan, camera: Camera, direction: Rigid, channel_set: ChannelSet, *, coarse: bool, harmonics: int
) -> ScanLevels | None:
    """Return the levels that were kept of the same scan, seen by the same camera; None if there are none.

    Args:
        scan: the scan itself: it is read-only, so that the same object has the same content.
        camera: the camera that the view would be made for.
        direction: the rotation (view from scanner).
        channel_set: the channels to compare.
        coarse: whether the scan is coarse.
        harmonics: of the channels.
    """
    for kept in _last[:]:
        found = kept.levels(scan, camera, direction, channel_set, coarse=coarse, harmonics=harmonics)
        if found is not None:
            return found
    return None


def forget() -> None:
    """Let go of the view that is kept."""
    _last.clear()
