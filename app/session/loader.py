"""What the document refers to, loaded and computed once: scans, photographs, views, answers."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, TypeVar

from ladarreg_core.errors import CameraError, FormatError, LadarregError

from .bounded_cache import BoundedCache, array_bytes
from .cache import EachOnce
from .isolated_readers import READERS

if TYPE_CHECKING:
    from pathlib import Path

    from ladarreg_core.inspection.picks import PickMeasurements, PickPredictor
    from ladarreg_core.inspection.pictures import NamedView
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.document import Document, PhotoEntry, PickEntry, PoseEntry, Source
    from ladarreg_core.project.folder import ProjectFolder
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.results import Registration
    from ladarreg_core.scan import Scan

log = logging.getLogger(__name__)
T = TypeVar("T")
_KEPT = {
    "scan": (1, 1),
    "photo": (8, 600_000_000),
    "views": (1, 1),
    "answer": (64, 100_000_000),
    "assessment": (32, 200_000_000),
    "partners": (3, 400_000_000),
    "measured": (8, 200_000_000),
    "picture": (24, 200_000_000),
    "line": (512, 50_000_000),
}
"""How many of each kind are kept, and how many bytes beside the newest; what was used longest ago goes first."""

_OF_THE_SCAN = ("views", "assessment", "partners", "measured", "picture", "line")


class Workroom:
    """Loads what is asked for, once; safe to be asked by several threads."""

    def __init__(self, folder: ProjectFolder) -> None:
        self._folder = folder
        self._kept: dict[str, BoundedCache[tuple[Any]]] = {
            kind: BoundedCache(most, most_bytes, lambda held: array_bytes(held[0]), they_grow=most < 100)
            for kind, (most, most_bytes) in _KEPT.items()
        }
        self._picks: EachOnce[PickEntry, Pick] = EachOnce(lambda pick: pick.as_pick())
        self._locks: dict[str, threading.RLock] = {kind: threading.RLock() for kind in _KEPT}

    def kept(self, kind: str, key: Hashable, make: Callable[[], T]) -> T:
        """Return what was made before under a key, or make it; others who ask for the same kind wait."""
        with self._locks[kind]:
            shelf = self._kept[kind]
            held = shelf.get(key)
            if held is None:
                held = (make(),)
                shelf.put(key, held)
                if kind == "scan":  # what was computed on the last one would keep it in memory
                    for other in _OF_THE_SCAN:
                        self._kept[other].clear()
            return held[0]

    def scan(self, document: Document) -> Scan | None:
        """Return the scan; None where none is open.

        Raises:
            LadarregError: if its file cannot be read any more.
        """
        source = document.scan
        if source is None:
            return None
        return self.kept("scan", source, lambda: self.read_scan(source))

    def picks(self, entry: PhotoEntry) -> list[Pick]:
        """Return a photograph's picks, on or off; those that did not change are the same objects."""
        return self._picks.of(entry.id, entry.picks)

    def read_scan(self, source: Source) -> Scan:
        """Read a scan's file."""
        from ladarreg_core.formats import read_scan

        return READERS.run(read_scan, self._folder.source_path(source.path), scan_index=source.index)

    def read_matches(self, path: Path, scan: Scan) -> list[Pick]:
        """Read a file of matches."""
        from ladarreg_core.formats.matches_file import read_matches

        return READERS.run(read_matches, path, scan)

    def try_photo(self, entry: PhotoEntry) -> None:
        """Read a photograph and keep it; meanwhile nobody waits who asks for another one.

        Raises:
            LadarregError: if its file cannot be read; a missing or wrong camera is told by `photo`.
        """
        there = self._kept["photo"]
        key, without_camera = (entry.source, entry.camera), (entry.source, "no camera")
        found = there.get(key) or self._read_photo(entry)
        self.kept("photo", key, lambda: found)
        if isinstance(found, CameraError) and without_camera not in there:
            to_look_at = self._without_camera(entry)
            self.kept("photo", without_camera, lambda: to_look_at)

    def photo(self, entry: PhotoEntry) -> Photo:
        """Return a photograph.

        Raises:
            CameraError: if nothing tells its focal length, or the camera does not fit.
            LadarregError: if its file cannot be read any more.
        """
        found = self.kept("photo", (entry.source, entry.camera), lambda: self._read_photo(entry))
        if isinstance(found, LadarregError):
            raise found
        return found

    def photo_to_look_at(self, entry: PhotoEntry) -> Photo:
        """Return a photograph, under a camera that is only good to look through where nothing tells the right one."""
        try:
            return self.photo(entry)
        except CameraError:
            return self.kept("photo", (entry.source, "no camera"), lambda: self._without_camera(entry))

    def _read_photo(self, entry: PhotoEntry) -> Photo | LadarregError:
        from ladarreg_core.formats import read_photo
        from ladarreg_core.formats.camera_file import read_camera

        given = entry.camera
        try:
            # By itself, so that a camera file that cannot be read is not laid to the photograph.
            file = given.file
            camera = None if file is None else READERS.run(read_camera, self._folder.source_path(file.path))
            return READERS.run(
                read_photo,
                self._folder.source_path(entry.source.path),
                camera=camera,
                focal_px=given.focal_px,
                focal_mm=given.focal_mm,
                sensor_mm=given.sensor_mm,
            )
        except CameraError as error:
            return error

    def _without_camera(self, entry: PhotoEntry) -> Photo:
        from ladarreg_core.formats import read_photo

        path = self._folder.source_path(entry.source.path)
        return READERS.run(read_photo, path, focal_mm=36.0, sensor_mm=36.0)

    def views(self, document: Document) -> tuple[NamedView, ...]:
        """Return the views of the scan; none where no scan is open.

        Raises:
            LadarregError: if its file cannot be read any more, or it cannot be viewed.
        """
        scan = self.scan(document)
        return () if scan is None else self.kept("views", document.scan, lambda: _views_of(scan))

    def try_scan(self, source: Source) -> None:
        """Read a scan and compute its views, and keep both; of one that is refused nothing is kept.

        Raises:
            LadarregError: if it cannot be read, or cannot be viewed.
        """
        scan = self.read_scan(source)
        views = _views_of(scan)
        self.kept("scan", source, lambda: scan)
        self.kept("views", source, lambda: views)

    def answer(self, pose: PoseEntry) -> Registration:
        """Return a stage's answer."""
        from ladarreg_core.project.results import registration_of

        return self.kept("answer", id(pose), lambda: (pose, registration_of(pose)))[1]

    def assessment(self, scan: Scan, pose: PoseEntry) -> Assessment:
        """Return what there is to say of a stage's answer."""
        from ladarreg_core.quality.assessment import assess

        return self.kept("assessment", id(pose), lambda: (pose, assess(scan, self.answer(pose))))[1]

    def assessed(self, pose: PoseEntry) -> Assessment | None:
        """Return what was found to say of a stage's answer; None where nobody has looked yet."""
        held = self._kept["assessment"].get(id(pose))
        return None if held is None else held[0][1]

    def partners(self, scan: Scan, pose: PoseEntry) -> PickPredictor:
        """Return where a pose puts picks in the other picture."""
        from ladarreg_core.inspection.picks import PickPredictor

        def make() -> tuple[Any, PickPredictor]:
            answer = self.answer(pose)
            return pose, PickPredictor(scan, answer.camera, answer.camera_from_scanner)

        return self.kept("partners", (id(pose), id(scan)), make)[1]

    def measured(self, scan: Scan, photo: Photo) -> PickMeasurements:
        """Return what the scan measures under picks of a photograph."""
        from ladarreg_core.inspection.picks import PickMeasurements

        return self.kept("measured", (id(scan), id(photo)), lambda: PickMeasurements(scan, photo))


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
