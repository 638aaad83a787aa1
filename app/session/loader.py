"""The loader: scans, photographs, views and registrations of a document, each read or computed once."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from ladarreg_core.errors import CameraError, FormatError, LadarregError

from ..process_resources import keep_heap_small
from .cache import GroupedCache, ListCache
from .isolated_readers import READERS
from .kept_on_disk import KeptOnDisk
from .photo_header import PhotoHeader, header_fields, header_of

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from ladarreg_core.camera import CameraModel
    from ladarreg_core.inspection.picks import PickMeasurements, PickPredictor
    from ladarreg_core.inspection.picture_forms import EncodedPicture
    from ladarreg_core.inspection.pictures import NamedView
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.document import Document, PhotoEntry, PickEntry, PoseEntry
    from ladarreg_core.project.source import Source
    from ladarreg_core.project.storage.folder import ProjectFolder
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.results.registration import Registration
    from ladarreg_core.scan import Scan
    from ladarreg_core.surface.perspective import View

log = logging.getLogger(__name__)
T = TypeVar("T")
_LIMITS = {
    "scan": (3, 700_000_000),
    "photo": (8, 600_000_000),
    "header": (1024, 10_000_000),
    "views": (6, 100_000_000),
    "view": (16, 280_000_000),
    "registration": (1024, 100_000_000),
    "solved_on": (1024, 50_000_000),
    "stale": (4096, 10_000_000),
    "assessment": (4, 100_000_000),
    "assessed": (4096, 50_000_000),
    "agreeing": (256, 10_000_000),
    "partners": (3, 400_000_000),
    "measured": (8, 200_000_000),
    "picture": (64, 420_000_000),
    "carried": (256, 20_000_000),
    "seen": (16, 1_000_000),
    "model": (40, 150_000_000),
    "fused": (2, 150_000_000),
    "sheet": (256, 1_000_000),
    "shown by": (1024, 200_000_000),
    "line": (512, 50_000_000),
    "station": (16, 20_000_000),
    "small photo": (1024, 20_000_000),
}
"""The largest number of values of each kind, and their largest total size besides the newest, bytes; of what is asked
for of every photograph with every edit there is room for all: with one too few, all would be made again."""

DEFAULT_CACHE_BYTES = 640_000_000
"""Largest total size of everything that is kept besides the scan and the newest value."""

STATION_POINTS = 60_000
"""Most points of a station that are kept for the 3-D view."""

_LARGE_SCAN_CELLS = 4_000_000
_READERS_AT_ONCE = 4

_DERIVED_FROM_SCAN = ("views", "view", "partners", "measured", "fused", "line")
"""Kinds whose values would keep a dropped scan in memory, or have its id in their keys, which Python may reuse."""


class Loader:
    """Loads what a document refers to and caches it; safe for several threads.

    Args:
        folder: the project's folder.
        cache_bytes: the largest size of all that is kept for reuse, besides the scan and the newest value.
    """

    def __init__(self, folder: ProjectFolder, *, cache_bytes: int = DEFAULT_CACHE_BYTES) -> None:
        self._folder, self._kept = folder, KeptOnDisk(folder)
        self.cache_bytes = cache_bytes
        self._cache = GroupedCache(
            _LIMITS, derived={"scan": _DERIVED_FROM_SCAN}, max_bytes=cache_bytes, uncounted=("scan",)
        )
        self._picks: ListCache[PickEntry, Pick] = ListCache(lambda pick: pick.as_pick())

    @property
    def cached_bytes(self) -> int:
        """Size of what is kept for reuse, besides the scan, when it was last measured."""
        return self._cache.bytes

    def cached(self, kind: str, key: Hashable, make: Callable[[], T]) -> T:
        """Return the cached value of a key, or make it; other callers that need the same kind wait."""
        return self._cache.get(kind, key, make)

    def known(self, kind: str, key: Hashable) -> Any:
        """Return the cached value of a key; None if there is none."""
        cached = self._cache[kind].get(key)
        return None if cached is None else cached[0]

    def scan(self, document: Document) -> Scan | None:
        """Return the scan; None where none is open. The most recently used ones of a project are kept.

        Raises:
            LadarregError: if its file can no longer be read.
        """
        source = document.scan
        if source is None:
            return None
        return self.cached("scan", source, lambda: self.read_scan(source))

    def picks(self, entry: PhotoEntry) -> list[Pick]:
        """Return a photograph's picks, enabled or not; unchanged ones are the same objects."""
        return self._picks.get(entry.id, entry.picks)

    def read_scan(self, source: Source) -> Scan:
        """Read a scan's file, or files, with the ranges that were smoothed; notes and errors name them as displayed."""
        from ladarreg_core.formats import read_scan
        from ladarreg_core.project.smoothing_edits import with_smoothings

        path, *_ = paths = self._folder.source_files(source)
        names = {file.name: name for file, name in zip(paths, source.names, strict=True) if file.name != name}
        try:
            scan = READERS.run(read_scan, path, **self._folder.scan_options(source))
        except LadarregError as error:
            raise type(error)(_with_names(str(error), names)) from None
        if any(name in note for note in scan.notes for name in names):
            scan = replace(scan, notes=tuple(_with_names(note, names) for note in scan.notes))
        if scan.ranges.size > _LARGE_SCAN_CELLS:
            keep_heap_small()
        return with_smoothings(scan, source)

    def station_points(self, source: Source, scan: Scan | None = None) -> NDArray[np.float32]:
        """Return points (N, 3) of a station for the 3-D view, m, at most `STATION_POINTS`, frame of its scanner.

        They are kept on disk: a project of many large scans opens without reading them all.

        Args:
            source: its file.
            scan: its scan, if it was read just now.

        Raises:
            LadarregError: if its file can no longer be read.
        """

        def thinned() -> NDArray[np.float32] | LadarregError:
            from ladarreg_core.inspection.scene_geometry import spread_points

            try:
                return self._kept.get(
                    "station points", [source], {"ranges": source.ranges, "most": STATION_POINTS},
                    lambda: spread_points(scan or self.read_scan(source), STATION_POINTS),
                )  # fmt: skip
            except LadarregError as error:  # kept, too: a damaged file is not read again with every drawing
                return error

        found = self.cached("station", source, thinned)
        if isinstance(found, LadarregError):
            raise found
        return found

    def read_matches(self, path: Path, scan: Scan) -> list[Pick]:
        """Read a matches file."""
        from ladarreg_core.formats.documents.matches_file import read_matches

        return READERS.run(read_matches, path, scan)

    def preload_photo(self, entry: PhotoEntry) -> None:
        """Read a photograph and cache it, without blocking readers of other photographs meanwhile.

        Raises:
            LadarregError: if its file cannot be read; a missing or unsuitable camera is reported by `photo`.
        """
        photos = self._cache["photo"]
        key, without_camera = (entry.source, entry.camera), (entry.source, "no camera")
        cached = photos.get(key)
        found = cached[0] if cached else self._read_photo(entry)
        self.cached("photo", key, lambda: found)
        if isinstance(found, CameraError) and without_camera not in photos:
            viewable = self._with_nominal_camera(entry)
            self.cached("photo", without_camera, lambda: viewable)

    def photo(self, entry: PhotoEntry) -> Photo:
        """Return a photograph.

        Raises:
            CameraError: if its focal length is unknown, or the camera does not fit.
            LadarregError: if its file can no longer be read.
        """
        found = self.cached("photo", (entry.source, entry.camera), lambda: self._read_photo(entry))
        if isinstance(found, LadarregError):
            raise found
        return found

    def viewable_photo(self, entry: PhotoEntry) -> Photo:
        """Return a photograph for display; where its camera is unknown, with a nominal one."""
        try:
            return self.photo(entry)
        except CameraError:
            return self.cached("photo", (entry.source, "no camera"), lambda: self._with_nominal_camera(entry))

    def header(self, entry: PhotoEntry) -> PhotoHeader:
        """Return what is known of a photograph without its pixels; it is kept however many photographs there are.

        Raises:
            LadarregError: if its file can no longer be read.
        """

        def read() -> tuple[Photo, str]:
            try:
                return self.photo(entry), ""
            except CameraError as fault:
                return self.viewable_photo(entry), str(fault)

        return self.cached("header", (entry.source, entry.camera), lambda: self._header(entry, read))

    def is_there(self, entry: PhotoEntry) -> bool:
        """Return whether a photograph's file is still there."""
        return all(path.is_file() for path in self._folder.source_files(entry.source))

    def preload_headers(self, entries: Sequence[PhotoEntry]) -> None:
        """Read the headers of many photographs, several at a time; those that cannot be read are passed over."""

        def preload(entry: PhotoEntry) -> None:
            def read() -> tuple[Photo, str]:
                found = self._read_photo(entry)
                if isinstance(found, LadarregError):
                    return self._with_nominal_camera(entry), str(found)
                return found, ""

            with suppress(Exception):  # the slice `photos` states it
                header = self._header(entry, read)
                self.cached("header", (entry.source, entry.camera), lambda: header)

        missing = [entry for entry in entries if (entry.source, entry.camera) not in self._cache["header"]]
        with ThreadPoolExecutor(min(_READERS_AT_ONCE, os.cpu_count() or 1)) as pool:
            list(pool.map(preload, missing))

    def _header(self, entry: PhotoEntry, read: Callable[[], tuple[Photo, str]]) -> PhotoHeader:
        """Return a header that is kept on disk, or made of what `read` returns: the photograph, and why its camera is
        not known."""

        def measured() -> dict[str, Any]:
            photo, error = read()
            self.small_photo(entry, photo)  # lists show it: the photograph need not be read for it again
            height, width = photo.pixels.shape[:2]
            return header_fields(PhotoHeader(
                width, height, photo.temperature_k is not None, photo.notes, None if error else photo.camera,
                photo.calibrated and not error, error,
            ))  # fmt: skip

        fields = self._kept.of_photo("photo header", entry, measured, is_sound=header_of)
        found = header_of(fields)
        assert found is not None, "it was made, or found to be sound"
        return found

    def small_photo(self, entry: PhotoEntry, photo: Photo | None = None) -> EncodedPicture:
        """Return the small picture of a photograph, made once and kept on disk.

        Args:
            entry: the photograph.
            photo: the same, if it was read just now.

        Raises:
            LadarregError: if its file can no longer be read.
        """
        from ladarreg_core.inspection import picture_forms

        def made() -> dict[str, Any]:
            picture = picture_forms.small((photo or self.viewable_photo(entry)).pixels)
            return {"data": np.frombuffer(picture.data, np.uint8), "media_type": picture.media_type}

        def kept() -> EncodedPicture:
            found = self._kept.of_photo("small photo", entry, made, is_sound=bool)
            return picture_forms.EncodedPicture(np.asarray(found["data"]).tobytes(), str(found["media_type"]))

        return self.cached("small photo", (entry.source, entry.camera.file), kept)

    def _read_photo(self, entry: PhotoEntry) -> Photo | CameraError:
        from ladarreg_core.formats import read_photo
        from ladarreg_core.formats.cameras.camera_file import read_noted_camera

        given = entry.camera
        try:
            # In a run of its own, so that errors name the camera file and not the photograph.
            file, picture = given.file, self._folder.source_path(entry.source.path)
            camera: CameraModel | None = None
            notes: tuple[str, ...] = ()
            if file is not None:
                camera, notes = READERS.run(
                    read_noted_camera,
                    self._folder.source_path(file.path),
                    name=given.name,
                    picture=entry.source.name,
                    picture_file=picture,
                )
            return READERS.run(
                read_photo,
                picture,
                camera=camera,
                camera_notes=notes,
                focal_px=given.focal_px,
                focal_mm=given.focal_mm,
                sensor_mm=given.sensor_mm,
                camera_model=given.model,
                temperature_unit=entry.source.temperature_unit,
            )
        except CameraError as error:
            return error

    def _with_nominal_camera(self, entry: PhotoEntry) -> Photo:
        from ladarreg_core.formats import read_photo

        path = self._folder.source_path(entry.source.path)
        unit = entry.source.temperature_unit
        return READERS.run(read_photo, path, focal_mm=36.0, sensor_mm=36.0, temperature_unit=unit)

    def views(self, document: Document) -> tuple[NamedView, ...]:
        """Return the views of the scan; none where no scan is open.

        Raises:
            LadarregError: if its file can no longer be read, or no view can show it.
        """
        scan = self.scan(document)
        return () if scan is None else self.cached("views", document.scan, lambda: _views_of(scan))

    def view(self, document: Document, number: int) -> View:
        """Return one of the views, with its pixels; the most recently used ones are kept.

        Raises:
            LadarregError: as `views`.
        """
        named = self.views(document)[number]
        return self.cached("view", (document.scan, number), lambda: named.view)

    def preload_scan(self, source: Source) -> None:
        """Read a scan, compute its views and cache both; nothing is cached of a scan that is refused.

        Raises:
            LadarregError: if it cannot be read, or no view can show it.
        """
        scan = self.read_scan(source)
        views = _views_of(scan)
        self.cached("scan", source, lambda: scan)
        self.cached("views", source, lambda: views)

    def seen_from_scan(self, document: Document, station: str = "") -> Document:
        """Return a document with a station's scan as its scan, and all photographs beside it: the poses of others are
        carried over.

        What is carried over is the same object as long as nothing that it rests on changes.

        Args:
            document: the document.
            station: id of the station; empty: the project's scan.

        Raises:
            OptionError: if there is no such station.
        """
        from ladarreg_core.project.station_edits import partner_of

        if not station and not any(photo.station for photo in document.photos):
            return document
        scan = partner_of(document, station)

        def seen(photo: PhotoEntry) -> PhotoEntry:
            if photo.station == station:
                return photo
            rests_on = (photo, document.scan, document.stations, document.survey, document.adjusted)
            key = station, *map(id, rests_on)
            return self.cached("carried", key, lambda: (rests_on, self._current_only(document, photo, station)))[1]

        def made() -> Document:
            return msgspec.structs.replace(document, scan=scan, photos=tuple(map(seen, document.photos)))

        return self.cached("seen", (station, id(document)), lambda: (document, made()))[1]

    def _current_only(self, document: Document, photo: PhotoEntry, station: str) -> PhotoEntry:
        """Return a photograph as it is beside a station's scan; a pose that is out of date stays so."""
        from ladarreg_core.project.station_edits import seen_from_scan

        found, pose = seen_from_scan(document, photo, station), photo.pose
        if pose is None or not found.poses or not self.stale(document, photo, pose):
            return found
        return msgspec.structs.replace(
            found, poses=tuple(msgspec.structs.replace(each, ranges="former") for each in found.poses)
        )

    def registration(self, pose: PoseEntry) -> Registration:
        """Return the registration that a stored pose belongs to.

        Raises:
            LadarregError: if its matches are missing or damaged.
        """
        from ladarreg_core.project.results import registration_of

        return self.cached("registration", id(pose), lambda: (pose, registration_of(pose)))[1]

    def solved_on(self, pose: PoseEntry) -> tuple[PickEntry, ...] | None:
        """Return the enabled picks that a pose was solved on; None if they are not known."""
        from ladarreg_core.project.results import solved_on

        return self.cached("solved_on", id(pose), lambda: (pose, solved_on(pose)))[1]

    def stale(self, document: Document, entry: PhotoEntry, pose: PoseEntry) -> str:
        """Return why a photograph's pose is out of date; empty if it is current."""
        from ladarreg_core.project.staleness import stale

        beside = document.beside(entry)
        scan = beside.clouds, beside.ranges
        key = (id(entry.picks), id(pose), *scan)
        return self.cached("stale", key, lambda: ((entry, pose), stale(entry, pose, self.solved_on(pose), *scan)))[1]

    def assessment(self, scan: Scan, pose: PoseEntry) -> Assessment:
        """Return the quality assessment of a pose."""
        from ladarreg_core.quality.assessment import assess

        def made() -> tuple[PoseEntry, Assessment]:
            found = assess(scan, self.registration(pose))
            self.cached("assessed", id(pose), lambda: (pose, found.without_cells()))
            return pose, found

        return self.cached("assessment", id(pose), made)[1]

    def known_assessment(self, pose: PoseEntry) -> Assessment | None:
        """Return the assessment of a pose, without the values of cells; None before it was computed."""
        cached = self.known("assessed", id(pose))
        return None if cached is None else cached[1]

    @property
    def assessment_changes(self) -> int:
        """How often assessments have come or gone: as long as it is the same, `known_assessment` is."""
        return self._cache["assessed"].changes

    def agreeing(self, pose: PoseEntry) -> dict[str, bool]:
        """Return which of the picks of a pose agree with the robust estimator.

        Raises:
            LadarregError: as `registration`.
        """
        from ladarreg_core.quality.suspects import agreeing_picks

        return self.cached("agreeing", id(pose), lambda: (pose, agreeing_picks(self.registration(pose))))[1]

    def partners(self, scan: Scan, pose: PoseEntry) -> PickPredictor:
        """Return the prediction of picks from one image to the other under a pose."""
        from ladarreg_core.inspection.picks import PickPredictor

        def make() -> tuple[Any, PickPredictor]:
            registration = self.registration(pose)
            return pose, PickPredictor(scan, registration.camera, registration.camera_from_scanner)

        return self.cached("partners", (id(pose), id(scan)), make)[1]

    def measured(self, scan: Scan, photo: Photo) -> PickMeasurements:
        """Return the measurements of the scan at picks of a photograph."""
        from ladarreg_core.inspection.picks import PickMeasurements

        return self.cached("measured", (id(scan), id(photo)), lambda: PickMeasurements(scan, photo))


def _with_names(text: str, names: Mapping[str, str]) -> str:
    """Return a text with files, uploaded ones have random names, named as they are displayed."""
    for name, shown in names.items():
        text = text.replace(name, shown)
    return text


def _views_of(scan: Scan) -> tuple[NamedView, ...]:
    from ladarreg_core.inspection.pictures import inspection_views

    try:
        return inspection_views(scan)
    except LadarregError:
        raise
    except MemoryError:
        raise FormatError("there is not enough memory for a view of the scan; open a smaller one") from None
    except Exception as error:
        log.exception("the views of a scan")
        raise FormatError(
            f"the scan cannot be drawn in perspective ({type(error).__name__}); check the file's angles or points"
        ) from None
