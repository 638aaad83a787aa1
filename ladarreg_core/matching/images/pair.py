"""The images of a pair: the photograph's pyramid, and the scan's in each view, computed once."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.features.channels import ALL_HARMONICS, FEW_HARMONICS
from ladarreg_core.matching.images.photo_levels import PhotoLevels, photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import ChannelSet, ScanLevels, pair_levels
from ladarreg_core.matching.images.support import is_coarse
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

_LARGEST_WHOLE_SCAN = 4_000_000  # cells; of larger scans only the part in the view is compared
_WINDOW_MARGIN = 32
_LARGEST_WINDOW = 8_000_000
_KEPT_VIEWS, _KEPT_VIEWS_OF_LARGE = 2, 1  # up to 240 MB each; one view needs two, upright and rolled


class PairLevels:
    """Levels of a pair, computed once and shared by all channel sets: the photo's, and the scan's in each view.

    Args:
        scan: the scan.
        photo: the photograph.
        levels_of: gives the photo's levels, with the arguments of `photo_levels`.
    """

    def __init__(self, scan: Scan, photo: Photo, *, levels_of: Callable[..., PhotoLevels] = photo_levels) -> None:
        self.scan = scan
        self.working = working_camera(scan, photo.pinhole)
        self.coarse = is_coarse(scan, photo.pinhole)
        """Whether the scan is compared as a coarse one."""
        self.harmonics = harmonics_of(scan, photo.pinhole)
        """Harmonics of the channels."""
        self._photo = photo
        self._levels_of = levels_of
        self._photo_levels: PhotoLevels | None = None
        self.kept_views = _KEPT_VIEWS_OF_LARGE if scan.ranges.size > _LARGEST_WHOLE_SCAN else _KEPT_VIEWS
        self._views: deque[tuple[Rigid, ScanLevels]] = deque()

    def as_dense(self) -> PairLevels:
        """Return the pair with its scan compared as if it was not coarse; the photo's levels are shared."""
        other = PairLevels(self.scan, self._photo, levels_of=self._levels_of)
        other.coarse, other._photo_levels = False, self._photo_levels
        return other

    def with_camera(self, camera: Camera) -> PairLevels:
        """Return the pair with another camera of the photo; nothing is shared."""
        other = PairLevels(self.scan, replace(self._photo, camera=camera), levels_of=self._levels_of)
        other.coarse = self.coarse
        return other

    @property
    def photo(self) -> PhotoLevels:
        """The photo's levels."""
        if self._photo_levels is None:
            self._photo_levels = self._levels_of(self._photo, self.working, harmonics=self.harmonics)
        return self._photo_levels

    @property
    def contrast(self) -> float:
        """Difference between the brightest and the darkest pixel of the photograph, of its planes the largest."""
        return max(float(plane.max() - plane.min()) for plane in self.photo.planes[0])

    def view(self, direction: Rigid, channel_set: ChannelSet) -> ScanLevels:
        """Return the scan's levels in one view.

        Args:
            direction: the rotation (view from scanner).
            channel_set: the channels to compare.
        """
        for known, levels in self._views:
            if (known.rotation == direction.rotation).all():
                return levels.with_channels(channel_set)
        self._make_room()  # before the next one takes as much memory
        view = perspective_view(self.scan, self.working, view_from_scanner=direction)
        if self.scan.ranges.size > _LARGEST_WHOLE_SCAN:
            view = view.of_window(margin=_WINDOW_MARGIN, most_cells=_LARGEST_WINDOW)
        levels = pair_levels(view.scan, view, channel_set=channel_set, coarse=self.coarse, harmonics=self.harmonics)
        self._views.append((direction, levels))
        return levels

    def has_view(self, direction: Rigid) -> bool:
        """Return whether the levels of a view have been computed."""
        return any((known.rotation == direction.rotation).all() for known, _ in self._views)

    def add_view(self, direction: Rigid, levels: ScanLevels) -> None:
        """Add the levels of a view that were computed for another photo."""
        self._make_room()
        self._views.append((direction, levels))

    def _make_room(self) -> None:
        while len(self._views) >= self.kept_views:
            self._views.popleft()


def harmonics_of(scan: Scan, camera: Camera) -> int:
    """Return the number of harmonics: a coarse scan shows few edges, whose directions must be well distinguished.

    Args:
        scan: the scan.
        camera: the photo's camera.
    """
    return ALL_HARMONICS if is_coarse(scan, camera) else FEW_HARMONICS
