"""The target `ros`: calibrations, static transforms, a URDF and a recording for ROS 2, RViz and Foxglove.

The parent of every camera is the scanner's frame, the child the camera's optical frame (x right, y down, z forward,
as REP 103 defines it, and as ladarreg's cameras have it). Pixels count from the centre of the first one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.photo_files import on_one_line, text_writer, undistorted
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.ros.mcap import TopicMessage, mcap_chunks
from ladarreg_core.export.ros.messages import (
    CLOUD_RECORD,
    StaticTransform,
    camera_info_message,
    cloud_message,
    image_message,
    transforms_message,
)
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.shell_command import shell_command
from ladarreg_core.frames import Rigid
from ladarreg_core.storage.atomic_write import write_bytes, write_chunks
from ladarreg_core.surface.texture.registered_texture import dimmed_levels, model_rows

SCANNER, MAP = "scanner", "map"
_ROWS_AT_ONCE = 128
_TIME_NS = 1_000_000_000  # of all messages: a registration has no clock, and zero means 'unset' to ROS
_JPEG_QUALITY = 95
_LONGEST_JPEG_PX = 65_500
_PLUMB_BOB_TERMS, _RATIONAL_TERMS = 5, 8


def ros_refusal(handed: RegisteredScan, options: ExportOptions) -> str | None:
    """Return a sentence if a camera fits no model of ROS and cannot be undistorted to one."""
    del options
    found = [on_one_line(one.photo.name) for one in handed.photos if one.camera.as_panorama is not None]
    if not found:
        return None
    return (
        f"{', '.join(found)} is equirectangular, and ROS describes perspective and fisheye cameras only; leave it out, "
        "or cut perspective views out of it"
    )


def ros_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return calibration and transform of every photograph, and for all together launch file, URDF and recording."""
    del options
    cameras = _cameras(handed)
    world = _world(handed)
    jobs: list[FileJob] = []
    for one in cameras:
        jobs += [
            (f"{one.name}.camera_info.yaml", text_writer(_camera_info(one))),
            (f"{one.name}.transform.yaml", text_writer(_transform_file(one.transform, one.words))),
        ]
        if one.undistorted:
            jobs.append((f"{one.name}.png", _picture_writer(one)))
    if world is not None:
        transform, words = world
        jobs.append((f"{SCANNER}.transform.yaml", text_writer(_transform_file(transform, words))))
    transforms = [*([world[0]] if world else []), *(one.transform for one in cameras)]
    words = [*(world[1] if world else []), *(line for one in cameras for line in one.words)]
    jobs += [
        ("static_transforms.launch.py", text_writer(_launch_file(transforms, words))),
        ("cameras.urdf", text_writer(_urdf(cameras))),
        ("scan.mcap", lambda path: write_chunks(path, _recording(handed, cameras, transforms, words, report))),
    ]
    return jobs


def rig_files(cameras: Mapping[str, tuple[Rigid, Sequence[str]]]) -> dict[str, str]:
    """Return the static transforms of cameras that are mounted on a scanner: a YAML for each, and one launch file.

    Args:
        cameras: by name, the pose `camera_from_scanner` of each, and comments.

    Returns:
        the contents of the files by their names.
    """
    found, transforms, every = {}, [], []
    for name, (camera_from_scanner, words) in cameras.items():
        transform = StaticTransform(
            parent=SCANNER, child=f"{name}_optical_frame", parent_from_child=camera_from_scanner.inverse
        )
        lines = [
            *map(on_one_line, words),
            f"Parent: {SCANNER} (x forward, y left, z up; metres). Child: {transform.child}, the camera's optical "
            "frame (x right, y down, z forward).",
            f"The transform is the pose of the camera in the frame {SCANNER}: it maps points of the child to the "
            "parent.",
        ]
        found[f"{name}.transform.yaml"] = _transform_file(transform, lines)
        transforms.append(transform)
        every += lines
    return {**found, "static_transforms.launch.py": _launch_file(transforms, every)}


@dataclass(frozen=True, slots=True, eq=False)
class _RosCamera:
    """A photograph as ROS describes it."""

    one: RegisteredPhoto
    name: str
    """Of its topics and files; letters, digits, underscores."""
    distortion_model: str
    distortion: tuple[float, ...]
    matrix: FloatArray
    """(3, 3), px."""
    undistorted: Camera | None
    """The camera of the picture that is written instead of the photograph; None: the photograph itself."""

    @property
    def transform(self) -> StaticTransform:
        """Its pose."""
        return StaticTransform(
            parent=SCANNER, child=f"{self.name}_optical_frame", parent_from_child=self.one.camera_from_scanner.inverse
        )

    @property
    def words(self) -> list[str]:
        """What every file says of it."""
        lines = [
            f"Photograph: {on_one_line(self.one.photo.name)}",
            f"Parent: {SCANNER} (x forward, y left, z up; metres). Child: {self.transform.child}, the camera's optical "
            "frame (x right, y down, z forward).",
            f"The transform is the pose of the camera in the frame {SCANNER}: it maps points of the child to the "
            "parent.",
        ]
        if self.undistorted is not None:
            lines.append(
                f"The lens has {len(self.one.camera.as_fields()['distortion'])} terms and ROS at most "
                f"{_RATIONAL_TERMS}: the calibration is of the undistorted picture {self.name}.png, not of the "
                "photograph."
            )
        return [*lines, f"Pose: {self.one.registration.standing}"]

    def pixels(self) -> ByteArray:
        """Return the picture that the calibration is of, (h, w, 3) RGB."""
        if self.undistorted is None:
            return self.one.photo.pixels
        return undistorted(self.one.photo, self.one.camera, self.undistorted)


def _cameras(handed: RegisteredScan) -> list[_RosCamera]:
    taken: list[str] = [SCANNER, MAP, "scan"]
    found = []
    for one in handed.photos:
        fields = one.camera.as_fields()
        terms = tuple(float(value) for value in fields["distortion"])
        matrix = np.array([[fields["fx"], 0, fields["cx"]], [0, fields["fy"], fields["cy"]], [0, 0, 1.0]])
        undistorted = None
        if one.camera.model == "fisheye":
            model, terms = "equidistant", terms or (0.0,) * 4
        elif len(terms) == _RATIONAL_TERMS:
            model = "rational_polynomial"
        else:
            model = "plumb_bob"
            if len(terms) > _RATIONAL_TERMS:
                pinhole = one.camera.as_pinhole
                assert pinhole is not None, "only a pinhole has so many terms"
                terms, undistorted = (), pinhole.without_distortion()
            terms = (*terms, *(0.0,) * (_PLUMB_BOB_TERMS - len(terms)))
        name = _ros_name(one.id, taken)
        taken.append(name)
        found.append(_RosCamera(one, name, model, terms, matrix, undistorted))
    return found


def _ros_name(photo_id: str, taken: Sequence[str]) -> str:
    """Return an id as a name of ROS: letters, digits and single underscores, beginning with a letter."""
    stem = re.sub(r"[^A-Za-z0-9]+", "_", photo_id).strip("_") or "photo"
    stem = stem if stem[0].isalpha() else f"photo_{stem}"
    name, number = stem, 2
    while name.lower() in {one.lower() for one in taken}:
        name, number = f"{stem}_{number}", number + 1
    return name


def _world(handed: RegisteredScan) -> tuple[StaticTransform, list[str]] | None:
    """Return the scanner's pose in the frame of the survey, if it is known, and what it is in words."""
    frame = handed.frame
    if frame.name != "world":
        if handed.scan.world_from_scanner is None:
            return None
        frame = OutputFrame.of(handed.scan, "world")
    transform = StaticTransform(parent=MAP, child=SCANNER, parent_from_child=frame.written_from_scanner)
    return transform, [
        f"Parent: {MAP}, the {frame.sentence}. Child: {SCANNER} (x forward, y left, z up; metres).",
        f"The transform is the pose of the scanner in the frame {MAP}: it maps points of the child to the parent.",
    ]


def _camera_info(one: _RosCamera) -> str:
    width, height = one.one.camera.size
    p = np.hstack([one.matrix, np.zeros((3, 1))])
    rows = (
        ("camera_matrix", one.matrix),
        ("distortion_coefficients", np.array([one.distortion])),
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", p),
    )
    lines = [f"# {line}" for line in [*one.words, "Pixels: (0, 0) is the centre of the first one."]]
    lines += [f"image_width: {width}", f"image_height: {height}", f"camera_name: {one.name}"]
    for name, values in rows:
        if name == "distortion_coefficients":
            lines.append(f"distortion_model: {one.distortion_model}")
        numbers = ", ".join(repr(float(value)) for value in values.ravel())
        lines += [f"{name}:", f"  rows: {values.shape[0]}", f"  cols: {values.shape[1]}", f"  data: [{numbers}]"]
    return "\n".join(lines) + "\n"


def _arguments(transform: StaticTransform) -> list[str]:
    keys = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = (*transform.xyz, *transform.xyzw)
    pairs = [text for key, value in zip(keys, values, strict=True) for text in (key, repr(value))]
    return [*pairs, "--frame-id", transform.parent, "--child-frame-id", transform.child]


def _transform_file(transform: StaticTransform, words: Sequence[str]) -> str:
    lines = [f"# {line}" for line in words]
    lines += [
        "# The quaternion is in the order x, y, z, w. To publish it:",
        f"#   ros2 run tf2_ros static_transform_publisher {shell_command(_arguments(transform))}",
        "header:",
        f"  frame_id: {transform.parent}",
        f"child_frame_id: {transform.child}",
        "transform:",
        "  translation:",
        *(f"    {key}: {value!r}" for key, value in zip("xyz", transform.xyz, strict=True)),
        "  rotation:",
        *(f"    {key}: {value!r}" for key, value in zip("xyzw", transform.xyzw, strict=True)),
    ]
    return "\n".join(lines) + "\n"


def _launch_file(transforms: Sequence[StaticTransform], words: Sequence[str]) -> str:
    lines = [
        *(f"# {line}" for line in words),
        "# To publish all of them: ros2 launch static_transforms.launch.py",
        "from launch import LaunchDescription",
        "from launch_ros.actions import Node",
        "",
        "",
        "def generate_launch_description():",
        "    return LaunchDescription([",
    ]
    for each in transforms:
        lines += [
            "        Node(",
            '            package="tf2_ros",',
            '            executable="static_transform_publisher",',
            f'            name="{each.parent}_to_{each.child}",',
            f"            arguments={_arguments(each)!r},",
            "        ),",
        ]
    return "\n".join([*lines, "    ])"]) + "\n"


def _urdf(cameras: Sequence[_RosCamera]) -> str:
    lines = ['<?xml version="1.0" encoding="utf-8"?>', '<robot name="registered_scan">', f'  <link name="{SCANNER}"/>']
    for one in cameras:
        # Two hyphens would end a comment of XML.
        lines += [f"  <!-- {escape(line).replace('--', '- -')} -->" for line in one.words]
        xyz, rpy = (" ".join(map(repr, values)) for values in (one.transform.xyz, one.transform.rpy))
        lines += [
            f'  <link name="{one.transform.child}"/>',
            f'  <joint name="{SCANNER}_to_{one.transform.child}" type="fixed">',
            f'    <parent link="{SCANNER}"/>',
            f'    <child link="{one.transform.child}"/>',
            "    <!-- rpy: rad, about the fixed axes x, then y, then z of the parent -->",
            f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>"]) + "\n"


def _recording(
    handed: RegisteredScan,
    cameras: Sequence[_RosCamera],
    transforms: Sequence[StaticTransform],
    words: Sequence[str],
    report: Report | None,
) -> Iterator[bytes | memoryview]:
    """Yield the bytes of the recording: transforms, cameras with their photographs, the cloud."""
    messages: list[TopicMessage] = [transforms_message(_TIME_NS, transforms)]
    for done, one in enumerate(cameras):
        if report is not None:
            report(Progress(done, len(cameras), f"encoding {one.one.photo.name}"))
        form, encoded = _encoded(one.pixels())
        frame = one.transform.child
        topic = f"/{one.name}/image_{'raw' if one.undistorted is None else 'rect'}/compressed"
        messages += [
            image_message(topic, frame, _TIME_NS, form, encoded),
            camera_info_message(
                f"/{one.name}/camera_info",
                frame,
                _TIME_NS,
                one.one.camera.size,
                one.distortion_model,
                one.distortion,
                one.matrix,
            ),
        ]
    count = int(np.count_nonzero(handed.scan.valid))
    messages.append(cloud_message("/scan/points", SCANNER, _TIME_NS, count, _points(handed, report)))
    notes = {
        "points": f"/scan/points: frame {SCANNER} (x forward, y left, z up; metres); rgb is the photograph's colour, "
        "or the dimmed laser intensity where no photograph shows a point",
        **{str(number): line for number, line in enumerate(words, 1)},
    }
    yield from mcap_chunks(messages, time_ns=_TIME_NS, metadata={"ladarreg": notes})


def _points(handed: RegisteredScan, report: Report | None) -> Iterator[bytes]:
    handed.compute_colors(report)
    scan, texture, height = handed.scan, handed.colors.texture, handed.scan.shape[0]
    levels = dimmed_levels(scan)
    for first in range(0, height, _ROWS_AT_ONCE):
        if report is not None:
            report(Progress(first, height, "writing the cloud"))
        rows = slice(first, first + _ROWS_AT_ONCE)
        valid = scan.valid[rows]
        points = scan.points_at(rows, slice(None))[valid]
        red, green, blue = model_rows(scan, texture, rows, levels)[valid].astype(np.uint32).T
        records = np.empty(len(points), CLOUD_RECORD)
        for axis, name in enumerate("xyz"):
            records[name] = points[:, axis]
        records["intensity"] = scan.intensity[rows][valid]
        records["rgb"] = red << 16 | green << 8 | blue
        yield records.tobytes()


def _encoded(pixels: ByteArray) -> tuple[str, bytes]:
    form = "jpeg" if max(pixels.shape[:2]) <= _LONGEST_JPEG_PX else "png"
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if form == "jpeg" else []
    if form == "jpeg":
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, encoded = cv2.imencode(f".{form}", pixels[..., ::-1], options)
    assert done, "an 8-bit image can always be encoded"
    return form, encoded.tobytes()


def _picture_writer(one: _RosCamera) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        done, encoded = cv2.imencode(".png", one.pixels()[..., ::-1])
        assert done, "an 8-bit image can always be encoded"
        write_bytes(path, encoded.tobytes())

    return write
