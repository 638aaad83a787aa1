"""The target `kalibr`: camchains of the photographs' cameras.

Pixels count from (0, 0) at the centre of the first one, as in ladarreg. `T_cn_cnm1` maps points of the previous
camera into this one's frame. Photographs of one scan are mostly taken one after another by a camera that was moved; a
chain of them is a rig only if the cameras were mounted together. Every photograph therefore has a camchain of its own,
and all of them together have another.

Source: Kalibr's wiki, "YAML formats" and "Supported models".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ladarreg_core.camera import CameraModel
from ladarreg_core.export.photo_files import on_one_line, text_writer, words_of
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid

_TERMS = 4
_CHAIN = "camchain"


def kalibr_refusal(handed: RegisteredScan, options: ExportOptions) -> str | None:
    """Return a sentence if a camera has no model in Kalibr."""
    del options
    refused = []
    for one in handed.photos:
        name, camera = on_one_line(one.photo.name)[:60], one.camera
        if camera.as_panorama is not None:
            refused.append(f"{name} is equirectangular")
        elif _distortion(camera) is None:
            terms = camera.as_fields()["distortion"]
            refused.append(f"the lens of {name} has {len(terms)} terms, of which more than the first four are not zero")
    if not refused:
        return None
    panoramas = any(one.camera.as_panorama is not None for one in handed.photos)
    others = "colmap or nerfstudio" if panoramas else "opencv or ros"  # these two refuse panoramas, too
    more = f"; so are {len(refused) - 3} more photographs" if len(refused) > 3 else ""
    return (
        f"{'; '.join(refused[:3])}{more}; Kalibr has pinholes with k1 k2 p1 p2 and fisheyes with k1 to k4: calibrate "
        f"with one of these, leave the photograph out, or export to {others}"
    )


def kalibr_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `camchain-ID.yaml` of every photograph and, of several, `camchain.yaml` of all."""
    del options, report
    jobs = [(f"{_CHAIN}-{one.id}.yaml", text_writer(_camchain(handed, [one]))) for one in handed.photos]
    if len(handed.photos) > 1:
        jobs.append((f"{_CHAIN}.yaml", text_writer(_camchain(handed, handed.photos))))
    return jobs


def _camchain(handed: RegisteredScan, photos: Sequence[RegisteredPhoto]) -> str:
    lines = ["# Pixels: (0, 0) is the centre of the first one. Cameras: x right, y down, z forward; metres."]
    if len(photos) > 1:
        lines += [
            "# T_cn_cnm1 maps points of the previous camera into this one's frame. The photographs were registered one",
            "# by one: take the chain as a rig only if their cameras were mounted together.",
        ]
    before: Rigid | None = None
    for index, one in enumerate(photos):
        pose = handed.written_from_camera(one).inverse
        lines += [f"# cam{index}: {line}" for line in words_of(handed, one)]
        lines += [f"# cam{index}: camera_from_world:", *(f"#   {_list(row)}" for row in pose.matrix.tolist())]
        lines.append(f"cam{index}:")
        overlaps = [other for other in range(len(photos)) if other != index]
        lines.append(f"  cam_overlaps: [{', '.join(map(str, overlaps))}]")
        lines += _intrinsics(one.camera, one.id)
        if before is not None:
            step = (pose @ before.inverse).matrix.tolist()
            lines += ["  T_cn_cnm1:", *(f"  - {_list(row)}" for row in step)]
        before = pose
    return "\n".join(lines) + "\n"


def lidar_chain(cameras: Mapping[str, tuple[Rigid, CameraModel, Sequence[str]]]) -> str | None:
    """Return the camchain of cameras that are mounted on a scanner; None if Kalibr has no model for any of them.

    `T_cam_lidar` is written as Kalibr writes `T_cam_imu`: it maps points of the scanner into the camera's frame.
    Cameras that Kalibr has no model for are left out.

    Args:
        cameras: by name, the pose `camera_from_scanner`, the camera, and comments.
    """
    known = {name: one for name, one in cameras.items() if _distortion(one[1]) is not None}
    if not known:
        return None
    lines = [f"# {on_one_line(line)}" for _, _, words in known.values() for line in words]
    lines += [
        "# Pixels: (0, 0) is the centre of the first one. Camera: x right, y down, z forward; scanner: x forward, y",
        "# left, z up; metres. T_cam_lidar maps points of the scanner into the camera's frame.",
    ]
    before: Rigid | None = None
    for index, (name, (pose, camera, _)) in enumerate(known.items()):
        lines += [
            f"cam{index}:",
            "  cam_overlaps: []",
            "  T_cam_lidar:",
            *(f"  - {_list(row)}" for row in pose.matrix.tolist()),
            *_intrinsics(camera, name),
        ]
        if before is not None:
            lines += ["  T_cn_cnm1:", *(f"  - {_list(row)}" for row in (pose @ before.inverse).matrix.tolist())]
        before = pose
    return "\n".join(lines) + "\n"


def _intrinsics(camera: CameraModel, topic: str) -> list[str]:
    fields, terms = camera.as_fields(), _distortion(camera)
    assert terms is not None, "others are refused before"
    return [
        "  camera_model: pinhole",
        f"  intrinsics: {_list([fields[name] for name in ('fx', 'fy', 'cx', 'cy')])}",
        f"  distortion_model: {'equidistant' if camera.model == 'fisheye' else 'radtan'}",
        f"  distortion_coeffs: {_list(terms)}",
        f"  resolution: [{camera.width}, {camera.height}]",
        f"  rostopic: /{''.join(c if c.isalnum() else '_' for c in topic)}/image_raw",
    ]


def _distortion(camera: CameraModel) -> list[float] | None:
    """Return the four terms of Kalibr; None if it has no model for the camera."""
    if camera.as_panorama is not None:
        return None
    terms = list(camera.as_fields()["distortion"])
    return None if any(terms[_TERMS:]) else [*terms[:_TERMS], *[0.0] * (_TERMS - len(terms))]


def _list(numbers: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(number)) for number in numbers)}]"
