"""Rigs in files: the pairs of a table are read, and the result is written as JSON, for ROS and for Kalibr."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ladarreg_core.errors import OptionError
from ladarreg_core.formats.parsing.untrusted import reading
from ladarreg_core.foundations.progress import Progress, Report

if TYPE_CHECKING:
    from ladarreg_core.export.overlay_video import OverlayFrame
    from ladarreg_core.registration.rig.results import RigPair, RigResult
    from ladarreg_core.scan import Scan

_VERSION = 1
_OF_ONE_CAMERA = ("rejected_guess", "covariance", "covariance_is", "sigma_deg", "sigma_mm", "cameras")
_FRAMES = 8
_HEAD_BYTES = 4096
_POSE_IS = (
    "maps scanner points to the camera frame: p_camera = R p_scanner + t; scanner: X forward, Y left, Z up; camera: x "
    "right, y down, z forward; metres"
)
_COVARIANCE_IS = (
    "of (w, c): R_true = exp([w]x) R_estimated, c = C_true - C_estimated, the camera's centre in the scanner frame, "
    "in rad and m"
)


def rig_files_of(path: str | Path) -> list[Path]:
    """Return the files that a rig is read from: a table with those that it names, or a recording.

    Raises:
        LadarregError: if the table is damaged, or there is no such file.
    """
    from ladarreg_core.formats.documents.rig_file import read_rig_table
    from ladarreg_core.formats.recorded_frames import recording_in
    from ladarreg_core.formats.recordings.recording import storage_of

    if not is_recording(path):
        return list(dict.fromkeys([Path(path), *(file for row in read_rig_table(path) for file in row.files)]))
    file = recording_in(path)
    with reading(file):
        return list(dict.fromkeys([file, storage_of(file)]))


def is_recording(path: str | Path) -> bool:
    """Return whether a rig is given as a recording, or as its folder, rather than as a table."""
    from ladarreg_core.formats.recorded_frames import recording_in
    from ladarreg_core.formats.recordings.recording import sniff_recording

    file = recording_in(path)
    if not file.is_file():
        return Path(path).is_dir()
    with open(file, "rb") as stream:
        return sniff_recording(stream.read(_HEAD_BYTES))


def read_rig(
    path: str | Path,
    *,
    cloud: str | None = None,
    images: Sequence[str] = (),
    frames: int | None = None,
    deskewed: bool = False,
    neighbors: bool = False,
    scan_options: Mapping[str, Any] | None = None,
    photo_options: Mapping[str, Any] | None = None,
    report: Report | None = None,
) -> list[RigPair]:
    """Read the pairs of a rig: those that a table names, or those of clouds and pictures of a recording.

    Args:
        path: a table (CSV), a recording (.bag, .mcap, .db3) or the folder of one of ROS 2.
        cloud: topic of the clouds of a recording; None: the only one.
        images: topics of pictures, one for each camera; empty: the only one.
        frames: most pairs of each camera that are chosen of a recording, 2 to 40; None: 8.
        deskewed: whether its clouds are corrected for the motion of the scanner. If not, pairs are chosen among those
            where the pictures move least.
        neighbors: also read the pictures before and after each pair, for the estimation of a time offset.
        scan_options: arguments of `read_scan` for all scans.
        photo_options: arguments of `read_photo` for all photographs; a row's own camera file precedes them, and they
            precede the camera that a recording states.
        report: receives the progress.

    Returns:
        The pairs, as `register_rig` takes them.

    Raises:
        OptionError: if an option of recordings is given with a table.
        LadarregError: if a file cannot be read, or a recording has no such topics, pairs or cameras.
    """
    from ladarreg_core.registration.rig.results import RigPair

    if is_recording(path):
        from ladarreg_core.formats.recorded_frames import read_frames

        options = dict(scan_options or {})
        found = read_frames(
            path, cloud=cloud if cloud is not None else options.get("topic"), images=images,
            frames=_FRAMES if frames is None else frames, deskewed=deskewed, neighbors=neighbors,
            scan_options=options, photo_options=photo_options, report=report,
        )  # fmt: skip
        several = len({frame.camera_name for frame in found}) > 1
        return [
            RigPair(frame.name, frame.scan, frame.photo, frame.camera_name if several else "", frame.taken)
            for frame in found
        ]
    given = {"the topic of clouds": cloud, "topics of pictures": images, "a number of frames": frames,
             "deskewed": deskewed, "a time offset": neighbors}  # fmt: skip
    wrong = [name for name, value in given.items() if value]
    if wrong:
        raise OptionError(
            f"{' and '.join(wrong)} can only be used with a recording, and {Path(path).name} is a table of pairs; omit "
            "this, or give a recording (.bag, .mcap, .db3, or the folder of one)"
        )
    return _read_table(path, scan_options or {}, photo_options or {}, report)


def _read_table(
    path: str | Path, scan_options: Mapping[str, Any], photo_options: Mapping[str, Any], report: Report | None
) -> list[RigPair]:
    from ladarreg_core.formats import read_photo, read_scan
    from ladarreg_core.formats.documents.rig_file import read_rig_table
    from ladarreg_core.registration.rig.results import RigPair

    rows = read_rig_table(path)
    several = len({row.camera_name for row in rows}) > 1
    found = []
    scans: dict[tuple[Path, ...], Scan] = {}
    for done, row in enumerate(rows):
        if report is not None:
            report(Progress(done, len(rows), f"reading {row.name}"))
        files = (row.scan, *row.more)
        if files not in scans:
            scans[files] = read_scan(row.scan, **{**scan_options, "more": row.more})
        own: dict[str, Any] = dict(photo_options)
        if row.camera is not None:
            own = {"camera": row.camera, "camera_name": own.get("camera_name")}
        if (
            own.get("camera") is not None
            and own.get("camera_name") is None
            and _is_named(own["camera"], row.camera_name)
        ):
            own["camera_name"] = row.camera_name
        photo = read_photo(row.photo, **own)
        found.append(RigPair(row.name, scans[files], photo, row.camera_name if several else ""))
    return found


def _is_named(camera_file: str | Path, name: str) -> bool:
    """Return whether a camera file has several cameras, one of which has a name."""
    from ladarreg_core.formats.cameras.camera_file import read_cameras

    if not name:
        return False
    cameras = read_cameras(camera_file)
    return len(cameras) > 1 and any(each.name.casefold() == name.casefold() for each in cameras)


def write_rig(
    folder: str | Path,
    result: RigResult,
    *,
    pairs: Sequence[RigPair] = (),
    inputs: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> dict[str, Any]:
    """Write `rig.json` and, of an accepted rig, the files for ROS and Kalibr into a new folder, all at once.

    Args:
        folder: output folder.
        result: the result.
        pairs: what it was registered from, for the overlay video; empty: none is written.
        inputs: the table and the files that it names.
        force: replace an earlier folder of a rig and nothing else.
        report: receives the progress.

    Returns:
        the document that was written.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    from ladarreg_core.export.json import write_result
    from ladarreg_core.export.overlay_video import write_overlay_video
    from ladarreg_core.export.photo_files import text_writer
    from ladarreg_core.export.targets.folder import FileJob, write_folder
    from ladarreg_core.export.targets.kalibr import lidar_chain
    from ladarreg_core.export.targets.ros import rig_files
    from ladarreg_core.formats.documents.pose_file import write_pose
    from ladarreg_core.storage.replacement import RIG_FILE

    fields = rig_document(result, inputs=inputs)
    jobs: list[FileJob] = [(RIG_FILE, lambda path: write_result(path, fields))]
    known = {
        name: (one.camera_from_scanner, one.cameras[0], _words(one))
        for name, one in (result.by_camera or {"camera": result}).items()
        if one.accepted and one.camera_from_scanner is not None
    }
    if known:
        texts = rig_files({name: (pose, words) for name, (pose, _, words) in known.items()})
        jobs += [(name, text_writer(text)) for name, text in texts.items()]
        chain = lidar_chain(known)
        if chain is not None:
            jobs.append(("camchain-lidar.yaml", text_writer(chain)))
        if result.by_camera:
            jobs += [
                (f"{name}.pose.json", partial(write_pose, camera_from_scanner=one[0])) for name, one in known.items()
            ]
        for name in known:
            own = result.by_camera.get(name, result)
            shown = _overlay_frames(own, [pair for pair in pairs if not result.by_camera or pair.camera_name == name])
            if shown:
                prefix = f"{name}." if result.by_camera else ""
                draw = partial(write_overlay_video, frames=shown, camera_from_scanner=known[name][0])
                jobs.append((f"{prefix}overlay.webp", draw))
    fields["files"] = [name for name, _ in jobs] if known else []
    write_folder(folder, lambda: jobs, inputs=inputs, force=force, report=report)
    return fields


def rig_document(result: RigResult, *, inputs: Sequence[str | Path] = ()) -> dict[str, Any]:
    """Return the contents of `rig.json`, JSON-ready."""
    from ladarreg_core.export.json import input_documents, plain, software_document
    from ladarreg_core.storage.replacement import RIG_FILES

    own = _verdict_fields(result)
    fields: dict[str, Any] = {"version": _VERSION, "kind": "rig", "software": software_document(), **own}
    if result.by_camera:
        fields = {name: value for name, value in fields.items() if name not in _OF_ONE_CAMERA}
        fields["by_camera"] = {name: _verdict_fields(one) for name, one in result.by_camera.items()}
    fields |= {
        "steps": [{"name": step.name, "seconds": round(step.seconds, 4), **step.detail} for step in result.steps],
        "options": dict(result.options),
        "seed": result.seed,
        "files": list(RIG_FILES) if result.accepted and not result.by_camera else [],
        "inputs": input_documents(list(inputs)),
    }
    return dict(plain(fields))


def _verdict_fields(result: RigResult) -> dict[str, Any]:
    """Return the pose, its uncertainty, the verdict and the evidence of a rig, or of one of its cameras."""
    from ladarreg_core.frames import ThesisParameters

    pose, known = result.camera_from_scanner, bool(np.isfinite(result.covariance).all())
    sigma = np.sqrt(np.diag(result.covariance)) if known else np.full(6, np.nan)
    matrix = None if pose is None else pose.matrix.tolist()
    fields: dict[str, Any] = {
        "camera_from_scanner": matrix if result.accepted else None,
        "camera_from_scanner_is": _POSE_IS,
    }
    if not result.accepted:
        fields["rejected_guess"] = matrix
    if pose is not None and result.accepted:
        six = ThesisParameters.from_pose(pose)
        fields |= {
            "scanner_from_camera": pose.inverse.matrix.tolist(),
            "in_words": f"{six.describe_position()}; {six.describe_orientation()}",
        }
    fields |= {
        "accepted": result.accepted,
        "reasons": list(result.reasons),
        "false_alarm": result.false_alarm,
        "covariance": result.covariance.tolist() if known else None,
        "covariance_is": _COVARIANCE_IS,
        "sigma_deg": np.degrees(sigma[:3]).tolist(),
        "sigma_mm": (1e3 * sigma[3:]).tolist(),
        "pairs": [one.as_dict() for one in result.pairs],
        "used": list(result.used),
        "refused": list(result.refused),
        "cameras": [camera.as_fields() for camera in result.cameras],
    }
    if result.time_offset is not None:
        fields["time_offset"] = result.time_offset.as_dict()
    return fields


def _overlay_frames(result: RigResult, pairs: Sequence[RigPair]) -> list[OverlayFrame]:
    """Return what the overlay video of a camera shows of each pair."""
    from ladarreg_core.export.overlay_video import OverlayFrame
    from ladarreg_core.registration.rig.time_offset import paired_at

    offset, evidence = result.time_offset, {one.name: one for one in result.pairs}
    found = []
    for pair in pairs:
        photo = paired_at(pair, offset.seconds).photo if offset is not None and offset.known else pair.photo
        one = evidence[pair.name]
        said = f"{one.fraction:.0%} of the regions agree" if one.outcome == "agrees" else f"{one.outcome}, not used"
        found.append(OverlayFrame(pair.scan, photo, f"{pair.name}: {said}"))
    return found


def _words(result: RigResult) -> list[str]:
    """Return what the files of a camera say of its pose."""
    sigma = np.sqrt(np.diag(result.covariance))
    return [
        result.reasons[0],
        f"Standard deviations: {_list(np.degrees(sigma[:3]).tolist())} deg about the axes of the camera, "
        f"{_list((1e3 * sigma[3:]).tolist())} mm of its centre in the scanner's frame.",
    ]


def _list(numbers: Sequence[float | None]) -> str:
    return ", ".join("?" if number is None else f"{number:.3g}" for number in numbers)
