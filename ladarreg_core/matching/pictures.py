"""Both pictures of a pair, made once for all that compares them: the photo's levels, and the scan's of each view."""

from __future__ import annotations

from collections import deque

from ladarreg_core.frames import Rigid
from ladarreg_core.matching.pyramid import (
    ChannelSet,
    PhotoLevels,
    ScanLevels,
    photo_levels,
    scan_levels,
    working_camera,
)
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

_KEPT_VIEWS = 2  # some ten bytes a pixel and channel: what a scan of one view needs, upright and rolled


class Pictures:
    """What the two pictures of a pair look like to the matcher, whichever channels of the scan are compared.

    Args:
        scan: the scan.
        photo: the photograph.
    """

    def __init__(self, scan: Scan, photo: Photo) -> None:
        self.scan = scan
        self.working = working_camera(scan, photo.camera)
        self._photo = photo
        self._photo_levels: PhotoLevels | None = None
        self._views: deque[tuple[Rigid, ScanLevels]] = deque(maxlen=_KEPT_VIEWS)

    @property
    def photo(self) -> PhotoLevels:
        """The photo's levels."""
        if self._photo_levels is None:
            self._photo_levels = photo_levels(self._photo, self.working)
        return self._photo_levels

    def view(self, direction: Rigid, channel_set: ChannelSet) -> ScanLevels:
        """Return the scan's levels in one view.

        Args:
            direction: the rotation (view from scanner).
            channel_set: what of the scan is compared.
        """
        for known, levels in self._views:
            if (known.rotation == direction.rotation).all():
                return levels.with_channels(channel_set)
        view = perspective_view(self.scan, self.working, view_from_scanner=direction)
        levels = scan_levels(self.scan, view, channel_set=channel_set)
        self._views.append((direction, levels))
        return levels
