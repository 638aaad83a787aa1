"""The result of a run: `adjustment.json`, shaped like that of a survey of one scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.batches.photos.folder import PHOTOS_FOLDER, SUMMARY_FILE
from ladarreg_core.batches.photos.photo_list import CameraGroup, PhotoEntry
from ladarreg_core.batches.photos.pooled_camera import PooledCamera
from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.export.json import CAMERA_FROM_SCANNER_IS, software_document
from ladarreg_core.formats.documents.own_results import read_own_result
from ladarreg_core.formats.parsing.untrusted import reading
from ladarreg_core.frames import Rigid
from ladarreg_core.storage.replacement import is_file_name

_VERSION = 1
_SCAN = "scan-1"
_COVARIANCE_IS = (
    "of (w, c): R_true = exp([w]x) R (rad), c = true minus estimated camera centre in the scanner frame (m); the "
    "uncertainty of the camera is in it"
)
_IN_SUMMARY = (
    "camera_from_scanner", "camera_from_world", "covariance", "accepted", "evidence", "precision", "reasons", "sigma",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class PhotosResult:
    """The result of `register_photos`."""

    folder: Path
    """The folder of the results."""
    document: Mapping[str, Any]
    """The contents of `adjustment.json`, without its checksum."""

    @property
    def accepted(self) -> bool:
        """Whether all photographs were accepted."""
        return all(one["accepted"] for one in self.photos.values())

    @property
    def photos(self) -> Mapping[str, Mapping[str, Any]]:
        """What the document says of each photograph, by its id."""
        found: Mapping[str, Mapping[str, Any]] = self.document["photos"]
        return found

    @property
    def cameras(self) -> Mapping[str, Mapping[str, Any]]:
        """What the document says of each camera, by its id."""
        found: Mapping[str, Mapping[str, Any]] = self.document["cameras"]
        return found

    def photo_folder(self, photo: str) -> Path:
        """Return the folder with the results of a photograph, by its id; a failed one has none."""
        return self.folder / PHOTOS_FOLDER / photo


def read_photos_result(folder: str | Path, *, trust_edited: bool = False) -> PhotosResult:
    """Return the result of a run that was written into a folder.

    Args:
        folder: the folder.
        trust_edited: take a document that was changed after it was written.

    Raises:
        FormatError: if the run was not finished, or its document is damaged, changed or of another version.
    """
    home = Path(folder)
    if not (home / SUMMARY_FILE).is_file():
        raise FormatError(f"{home} is the folder of a run that was not finished; run the same command again")
    with reading(home / SUMMARY_FILE) as file:
        fields = read_own_result(file, "adjustment", trust_edited=trust_edited)
        photos, cameras = fields.get("photos"), fields.get("cameras")
        if fields.get("version") != _VERSION or not isinstance(photos, dict) or not isinstance(cameras, dict):
            raise FormatError(f"it is of another version than {_VERSION}, or damaged; register the photos again")
        if not all(is_file_name(name) and "/" not in name and isinstance(one, dict) for name, one in photos.items()):
            raise FormatError("it names photographs outside its folder; register the photos again")
    return PhotosResult(home, fields)


def accepted_folders(folder: str | Path, *, trust_edited: bool = False) -> list[Path]:
    """Return the folders of results of the photographs that a run accepted; arguments as of `read_photos_result`.

    Raises:
        FormatError: as of `read_photos_result`.
        ExportError: if it accepted none.
    """
    result = read_photos_result(folder, trust_edited=trust_edited)
    found = [result.photo_folder(name) for name, one in result.photos.items() if one.get("accepted") is True]
    if not found:
        raise ExportError(f"no photo in {folder} was accepted, so nothing can be exported")
    return found


def describe_photos(folder: str | Path) -> dict[str, Any]:
    """Return what a run found, JSON-ready: the verdicts, and the cameras.

    Raises:
        FormatError: as of `read_photos_result`.
    """
    result = read_photos_result(folder)
    return {
        "kind": "results of many photos",
        "accepted": f"{sum(one.get('accepted') is True for one in result.photos.values())} of {len(result.photos)}",
        "photos": [f"{name}: {one.get('verdict')}" for name, one in result.photos.items()],
        "cameras": [
            f"{name}: {one.get('is')}; {len(one.get('pooled') or ())} photos pooled"
            for name, one in result.cameras.items()
        ],
    }


def summary_document(
    entries: Sequence[PhotoEntry],
    groups: Sequence[CameraGroup],
    cameras: Mapping[str, PooledCamera | None],
    results: Mapping[str, Mapping[str, Any]],
    *,
    scan: Mapping[str, Any],
    world_from_scanner: Rigid | None,
    options: Mapping[str, Any],
    inputs: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the contents of `adjustment.json`, which has neither times nor the folder of anything.

    Args:
        entries: the photographs.
        groups: their cameras.
        cameras: the pooled cameras, by the ids of the groups; None or absent: it was not pooled.
        results: `summary_fields` of each photograph, by its id.
        scan: name and notes of the scan, and its files.
        world_from_scanner: its pose.
        options: of the registrations.
        inputs: name, size and SHA-256 of the photographs, by their ids.
    """
    camera_of = {entry.id: group.id for group in groups for entry in group.photos}
    return {
        "version": _VERSION,
        "kind": "adjustment",
        "software": software_document(),
        "camera_from_scanner_is": CAMERA_FROM_SCANNER_IS,
        "covariance_is": _COVARIANCE_IS,
        "scans": {
            _SCAN: {
                **scan,
                "world_from_scanner": None if world_from_scanner is None else world_from_scanner.matrix.tolist(),
                "covariance": None,
                "accepted": True,
                "reasons": ["The only scan: its frame is that of all poses."],
            }
        },
        "cameras": {group.id: _camera_document(group, cameras.get(group.id), results) for group in groups},
        "photos": {
            entry.id: {
                **{name: results[entry.id].get(name) for name in _IN_SUMMARY},
                "verdict": results[entry.id]["verdict"],
                "scans": [_SCAN] if results[entry.id].get("camera_from_scanner") is not None else [],
                "camera": camera_of.get(entry.id),
                "folder": f"{PHOTOS_FOLDER}/{entry.id}" if "camera" in results[entry.id] else None,
                "input": inputs.get(entry.id, {"name": entry.path.name}),
            }
            for entry in entries
        },
        "options": options,
    }


def _camera_document(
    group: CameraGroup, pooled: PooledCamera | None, results: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return a camera: pooled, or that of the one photograph, or null where several have one each."""
    facts = group.photos[0].facts
    assert facts is not None, "only photographs that can be read have a camera"
    document: dict[str, Any] = {"is": group.words, "photos": [entry.id for entry in group.photos]}
    if pooled is not None:
        camera = pooled.camera(facts.width, facts.height, 1)
        return {
            **document,
            "camera": camera.as_fields(),
            "camera_is": "of the pixels as stored, before EXIF's orientation is applied",
            "sigmas": pooled.sigmas,
            "covariance": pooled.covariance.tolist(),
            "pooled": list(pooled.photos),
            "disagreeing": list(pooled.disagreeing),
        }
    found = [one for entry in group.photos if (one := results[entry.id]).get("accepted")]
    alike = bool(found) and all(one["camera"] == found[0]["camera"] for one in found)
    return {
        **document,
        "camera": found[0]["camera"] if alike else None,
        "sigmas": found[0]["camera_sigmas"] if alike else {},
        "pooled": [],
        "disagreeing": [],
    }
