"""Reads what a survey is made of: its scans, which are kept in the cache, and the cameras of its photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.photo_task import ScanFiles
from ladarreg_core.batches.photos.pooled_camera import may_be_turned
from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.export.json import input_document, input_documents, plain
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.photos.photo_facts import photo_facts
from ladarreg_core.scan import Scan
from ladarreg_core.survey.parts import SurveyCamera, SurveyPhoto, listed_faults
from ladarreg_core.survey.survey import Survey
from ladarreg_core.survey.work import PhotoFiles


@dataclass(frozen=True, slots=True, eq=False)
class PhotoHeader:
    """A photograph's file, and its camera before anything is adjusted."""

    files: PhotoFiles
    camera: CameraModel
    assumed: bool
    """Whether only its focal length is known."""
    orientation: int
    """EXIF's orientation, by which photographs of one camera were turned."""


@dataclass(frozen=True, slots=True, eq=False)
class SurveyInputs:
    """Reads the files of a survey, and notes what they are."""

    survey: Survey
    cache: ContentCache
    documents: dict[str, Any] = field(default_factory=dict)
    """Name, size and hash of every file that was read, by `scan/ID` and `photo/ID`."""

    def scans(self, report: Callable[[str], None]) -> list[tuple[ScanFiles, Scan]]:
        """Return the scans, which the cache keeps from now on.

        Raises:
            LadarregError: if one cannot be read.
        """
        found = []
        for one in self.survey.scans:
            options = {**one.options, "scan_index": one.index}
            if isinstance(one.source, Scan):
                content = [ContentCache.key(ranges=_digest(one.source.ranges), intensity=_digest(one.source.intensity))]
            else:
                (document,) = input_documents([one.source], [options])
                self.documents[f"scan/{one.id}"] = document
                content = [document["sha256"]]
            stated = None if one.world_from_scanner is None else one.world_from_scanner.matrix.tolist()
            key = ContentCache.key(kind="survey scan", content=content, options=plain(options), world=stated)
            scan = one.source if isinstance(one.source, Scan) else self.cache.get(key)
            if not isinstance(scan, Scan):
                assert isinstance(one.source, Path)
                scan = read_scan(one.source, **options)
            if one.world_from_scanner is not None:
                scan = replace(scan, world_from_scanner=one.world_from_scanner)
            if key not in self.cache:
                self.cache.put(key, scan)
            if one.targets is not None:
                self.documents[f"targets/{one.id}"] = input_document(one.targets.source)
            path = None if isinstance(one.source, Scan) else one.source
            found.append((ScanFiles(path, options, key, self.cache.folder, self.cache.most_bytes), scan))
            report(f"reading {one.id}")
        return found

    def headers(self, report: Callable[[str], None]) -> dict[str, PhotoHeader]:
        """Return the camera of each photograph; faults of all of them are reported together, before any work.

        Raises:
            FormatError: if some cannot be read, or their cameras are not known.
        """
        cameras, found, faults = {one.id: one for one in self.survey.cameras}, {}, []
        for given in self.survey.photos:
            try:
                files = self._photo_files(given, cameras[given.camera])
                photo = files.read()
                orientation = _orientation(given, cameras[given.camera])
                found[given.id] = PhotoHeader(files, photo.camera, photo.assumed, orientation)
            except LadarregError as error:
                faults.append(str(error))
            report(f"reading {given.id}")
        if faults:
            raise FormatError(listed_faults("the survey", faults))
        return found

    def _photo_files(self, given: SurveyPhoto, camera: SurveyCamera) -> PhotoFiles:
        options = dict(camera.options)
        if camera.source is not None:
            options["camera"] = camera.source
        if isinstance(given.source, Path):
            document = input_document(given.source)
            self.documents[f"photo/{given.id}"] = document
            stated: Any = options.get("camera")
            if isinstance(stated, Path):
                stated = input_document(stated)["sha256"]
            elif stated is not None:
                stated = stated.as_fields()
            key = ContentCache.key(photo=document["sha256"], options=plain({**options, "camera": stated}))
            return PhotoFiles(id=given.id, source=given.source, options=options, key=key)
        photo = given.source
        if camera.source is not None:
            if isinstance(camera.source, Path):
                raise OptionError(f"the photo {given.id} is in memory, and its camera is a file; give both alike")
            photo = replace(photo, camera=camera.source, calibrated=True, assumed=False, alternatives=())
        key = ContentCache.key(photo=_digest(photo.pixels), camera=photo.camera.as_fields(), assumed=photo.assumed)
        return PhotoFiles(id=given.id, source=photo, key=key)


def _orientation(photo: SurveyPhoto, camera: SurveyCamera) -> int:
    """Return EXIF's orientation, by which photographs of one camera were turned; 1 where that is not of the camera.

    A camera that is given is that of upright pixels, and no camera takes mirrored ones.
    """
    if not isinstance(photo.source, Path) or camera.source is not None:
        return 1
    orientation = photo_facts(photo.source).orientation
    return orientation if may_be_turned(orientation) else 1


def _digest(array: Any) -> str:
    from hashlib import sha256

    return sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
