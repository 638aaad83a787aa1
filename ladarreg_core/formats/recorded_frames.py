"""Clouds and photographs of a recording as pairs: those that were taken at one moment, at different places.

Clouds and pictures are paired by the time stamps in their headers. Of a long recording a few pairs are chosen that show
different places, by small copies of their pictures.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading
from ladarreg_core.formats.photo_file import read_photo
from ladarreg_core.formats.photos.image_file import as_rgb, read_image
from ladarreg_core.formats.recordings.images import recorded_camera, write_picture
from ladarreg_core.formats.recordings.recording import (
    CLOUD_TYPES,
    IMAGE_TYPES,
    METADATA_FILE,
    Message,
    Recording,
    chosen_topic,
    opened_recording,
    shown,
    storage_of,
)
from ladarreg_core.formats.scans.bag import AccumulatedClouds
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import require_int, require_positive
from ladarreg_core.photo import Photo, TimedPhoto
from ladarreg_core.scan import Scan

MAX_FRAMES = 40
"""Largest number of pairs that are read of a recording."""
NEIGHBORS = 6
"""Number of pictures before and after that of a pair that are read for the estimation of a time offset."""

_CONSIDERED = 8  # pairs that are looked at for each one that is chosen
_THUMB = (48, 32)
_THUMB_BLUR_PX = 1.5
_STILL = 1e-4  # correlation by which the noise of a camera at rest differs
_GENERIC = ("image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "compressed", "raw")
_CAMERA_OPTIONS = ("camera", "focal_px", "focal_mm", "camera_model")


@dataclass(frozen=True, slots=True, eq=False)
class RecordedFrame:
    """A cloud and the photograph that was taken at its time."""

    name: str
    """For messages: the camera and the time since the first cloud."""
    camera_name: str
    """Of the camera, from its topic."""
    scan: Scan
    photo: Photo
    taken: tuple[TimedPhoto, ...]
    """That photograph and, if asked for, those before and after it, by time."""


@dataclass(frozen=True, slots=True)
class _Pair:
    """A cloud and a picture by their positions on their topics."""

    cloud: int
    image: int


def recording_in(path: PathLike) -> Path:
    """Return the file of a recording that is given, or that describes a folder of ROS 2 that is given."""
    given = Path(path)
    return given / METADATA_FILE if given.is_dir() else given


def read_frames(
    path: PathLike,
    *,
    cloud: str | None = None,
    images: Sequence[str] = (),
    frames: int = 8,
    deskewed: bool = False,
    neighbors: bool = False,
    scan_options: Mapping[str, Any] | None = None,
    photo_options: Mapping[str, Any] | None = None,
    report: Report | None = None,
) -> list[RecordedFrame]:
    """Read pairs of clouds and photographs of a recording.

    Args:
        path: a ROS 1 bag, the storage or metadata.yaml of a ROS 2 bag, or its folder.
        cloud: topic of the clouds; None: the only one.
        images: topics of pictures, one for each camera; empty: the only one.
        frames: most pairs of each camera, 2 to `MAX_FRAMES`.
        deskewed: whether the clouds are corrected for the motion of the scanner during its turn. If not, pairs are
            chosen among those where the pictures move least.
        neighbors: also read the pictures before and after each pair.
        scan_options: `origin`, `intensity` and `seconds` of `read_scan`; the latter accumulates the clouds that follow.
        photo_options: arguments of `read_photo`; a camera or focal length among them precedes the recording's own.
        report: receives the progress.

    Returns:
        The pairs, camera by camera, in the order of time. Notes of the photographs say how they were chosen.

    Raises:
        FormatError: if there are no clouds, no pictures, no pairs of them, or a message is damaged.
        CameraError: if the recording states no camera that can be used, and none is given.
        UnderspecifiedError: if there are several topics, and none is chosen.
        OptionError: if there is no topic of that name, or a number is out of range.
    """
    require_int(frames, "the number of frames", least=2, most=MAX_FRAMES)
    options = dict(scan_options or {})
    if options.get("seconds") is not None:
        require_positive(options["seconds"], "seconds", unit="s")
    with reading(recording_in(path)) as file:
        storage = storage_of(file)
        with opened_recording(storage) as recording:
            clouds = recording.topics(CLOUD_TYPES)
            pictures = recording.topics(IMAGE_TYPES)
            for found, what in (
                (clouds, "sensor_msgs/PointCloud2"),
                (pictures, "sensor_msgs/Image or CompressedImage"),
            ):
                if not found:
                    has = one_line(", ".join(recording.types), 120) or "no messages"
                    raise FormatError(f"it has no {what}, but {has}; pairs of clouds and photographs need both")
            chosen = chosen_topic(clouds, cloud, what="clouds", option="cloud")
            topics = list(dict.fromkeys(
                chosen_topic(pictures, name, what="pictures", option="images") for name in (images or (None,))
            ))  # fmt: skip
            names = _camera_names(topics)
            reader = _FrameReader(
                recording, chosen, ReadBudget.of(storage.stat().st_size), options, dict(photo_options or {}), report
            )
            found_frames: list[RecordedFrame] = []
            for topic, name in zip(topics, names, strict=True):
                found_frames += reader.frames(
                    topic, name, tuple(pictures), most=frames, deskewed=deskewed, neighbors=neighbors
                )
            return found_frames


class _FrameReader:
    """Reads the pairs of one topic of clouds with topics of pictures."""

    def __init__(
        self,
        recording: Recording,
        cloud_topic: str,
        budget: ReadBudget,
        scan_options: dict[str, Any],
        photo_options: dict[str, Any],
        report: Report | None,
    ) -> None:
        self._recording = recording
        self._cloud_topic = cloud_topic
        self._budget = budget
        self._scan_options = scan_options
        self._photo_options = photo_options
        self._report = report
        self._clouds = self._times(cloud_topic, CLOUD_TYPES)
        self._scans: dict[int, Scan | None] = {}

    def frames(
        self, topic: str, camera_name: str, image_topics: tuple[str, ...], *, most: int, deskewed: bool, neighbors: bool
    ) -> list[RecordedFrame]:
        """Return the pairs with the pictures of one topic."""
        stated = any(self._photo_options.get(name) is not None for name in _CAMERA_OPTIONS)
        camera, note = (None, "") if stated else recorded_camera(self._recording, topic, image_topics)
        self._say(0, f"pairing {topic}")
        images = self._times(topic, IMAGE_TYPES)
        cloud_times, image_times, by = _comparable_times(self._clouds, images)
        pairs = _paired(cloud_times, image_times)
        if not pairs:
            raise FormatError(
                f"no picture of {shown(topic)} was taken within half a period of a cloud of "
                f"{shown(self._cloud_topic)}: "
                f"{_extent(cloud_times)} against {_extent(image_times)}; choose topics that were recorded together"
            )
        considered = _spread(pairs, _CONSIDERED * most)
        moving = deskewed or neighbors  # of a rig that stands no time offset can be told
        chosen = self._at_different_places(topic, considered, len(image_times), most=most, moving=moving)
        begin = float(cloud_times[0])
        said = (
            f"{len(pairs)} clouds of {shown(self._cloud_topic)} and pictures of {shown(topic)} are pairs by {by}; "
            f"{len(chosen)} of them at different places are used",
            *([note] if note else []),
            *([] if deskewed else [_NOT_DESKEWED + (_CALM if len(considered) > most and not moving else "")]),
        )
        reach = NEIGHBORS if neighbors else 0
        wanted = sorted({
            index for pair in chosen for index in range(pair.image - reach, pair.image + reach + 1)
            if 0 <= index < len(image_times)
        })  # fmt: skip
        self._say(1, f"reading {topic}")
        photos = self._photos(topic, camera_name, wanted, camera, said)
        self._read_scans([pair.cloud for pair in chosen], cloud_times)
        found = []
        for pair in chosen:
            scan, photo = self._scans.get(pair.cloud), photos[pair.image]
            if scan is None:
                continue
            name = f"{camera_name} {cloud_times[pair.cloud] - begin:.2f} s"
            near = (index for index in wanted if abs(index - pair.image) <= reach)
            taken = tuple(
                TimedPhoto(float(image_times[index] - cloud_times[pair.cloud]), replace(photos[index], name=name))
                for index in near
            )
            found.append(RecordedFrame(name, camera_name, replace(scan, name=name), replace(photo, name=name), taken))
        if not found:
            raise FormatError(f"no cloud of {shown(self._cloud_topic)} with a picture has points; choose another topic")
        self._say(2, f"reading {topic}")
        return found

    def _times(self, topic: str, types: tuple[str, ...]) -> NDArray[np.int64]:
        """Return the times (N, 2) of the messages of a topic, ns: when they were stamped, and recorded."""
        every = [(message.stamp_ns, message.recorded_ns) for _, message in self._recording.messages(topic, types)]
        return np.array(every, dtype=np.int64).reshape(-1, 2)

    def _at_different_places(
        self, topic: str, pairs: Sequence[_Pair], count: int, *, most: int, moving: bool
    ) -> list[_Pair]:
        """Return the pairs that show places as different as possible, in the order of time."""
        if len(pairs) <= most:
            return list(pairs)
        after = {pair.image: min(pair.image + 1, count - 1) for pair in pairs}
        thumbs = {
            index: _thumb(self._pixels(kind, message))
            for index, (kind, message) in enumerate(self._recording.messages(topic, IMAGE_TYPES))
            if index in after or index in after.values()
        }
        kept = list(pairs)
        if not moving:
            moved = np.array([1 - float(thumbs[pair.image] @ thumbs[after[pair.image]]) for pair in pairs])
            least = max(float(np.median(moved)), float(np.sort(moved)[most - 1]))
            kept = [pair for pair, each in zip(pairs, moved, strict=True) if each <= least + _STILL]
        seen = np.stack([thumbs[pair.image] for pair in kept])
        return [kept[index] for index in _farthest_apart(seen, most)]

    def _pixels(self, kind: str, message: Message) -> NDArray[np.uint8]:
        with tempfile.TemporaryDirectory() as folder:
            return as_rgb(
                read_image(self._written(kind, message, Path(folder), "picture"), budget=self._budget).values
            )[0]

    def _photos(
        self, topic: str, camera_name: str, wanted: Sequence[int], camera: CameraModel | None, notes: tuple[str, ...]
    ) -> dict[int, Photo]:
        found: dict[int, Photo] = {}
        chosen = set(wanted)
        with tempfile.TemporaryDirectory() as folder:
            for index, (kind, message) in enumerate(self._recording.messages(topic, IMAGE_TYPES)):
                if index not in chosen:
                    continue
                photo = self._photo_of(kind, message, Path(folder), f"{camera_name}_picture_{index}", camera)
                found[index] = replace(photo, notes=(*photo.notes, *notes), source=None)
        return found

    def _photo_of(self, kind: str, message: Message, folder: Path, name: str, camera: CameraModel | None) -> Photo:
        """Return the photograph of a message with the recording's camera, or the stated one."""
        file = self._written(kind, message, folder, name)
        try:
            if camera is None:
                return read_photo(file, **{"temperature_unit": "none", **_given(self._photo_options)})
            return read_photo(file, camera=camera, temperature_unit="none")
        finally:
            file.unlink()

    def _written(self, kind: str, message: Message, folder: Path, name: str) -> Path:
        self._budget.require(4 * len(message.raw), f"a message of {len(message.raw):,} bytes")
        return write_picture(self._recording.decoded(message.raw, kind), folder, name)

    def _read_scans(self, wanted: Sequence[int], times: FloatArray) -> None:
        """Read the clouds at some positions, each with those that follow within the duration to be accumulated."""
        duration = self._scan_options.get("seconds") or 0.0
        missing = [index for index in wanted if index not in self._scans]
        read = {index: AccumulatedClouds(self._budget) for index in missing}
        for index, (kind, message) in enumerate(self._recording.messages(self._cloud_topic, CLOUD_TYPES)):
            into = [k for k in missing if k == index or 0 < times[index] - times[k] < duration]
            if not into:
                continue
            self._budget.require(2 * len(message.raw), f"a message of {len(message.raw):,} bytes")
            decoded = self._recording.decoded(message.raw, kind)
            for k in into:
                read[k].add(message.recorded_ns, decoded)
        for index, accumulated in read.items():
            self._scans[index] = None if accumulated.first is None else self._scan(accumulated)

    def _scan(self, accumulated: AccumulatedClouds) -> Scan:
        origin = self._scan_options.get("origin")
        if accumulated.is_in_fixed_frame and origin is None:
            raise FormatError(
                f"the clouds of {shown(self._cloud_topic)} are in the frame {shown(accumulated.frame)}, in which the "
                "scanner moves; a rig needs clouds in the scanner's own frame: choose another topic by `cloud`"
            )
        return accumulated.scan(
            "cloud", self._cloud_topic, intensity=self._scan_options.get("intensity") or "auto", origin=origin
        )

    def _say(self, done: int, label: str) -> None:
        if self._report is not None:
            self._report(Progress(done, 2, label))


_NOT_DESKEWED = (
    "the clouds are taken as they were recorded; those of a scanner that moves are distorted, unless they were "
    "corrected for it: then state `deskewed`"
)
_CALM = "; pairs were chosen where the pictures move least"


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _camera_names(topics: Sequence[str]) -> list[str]:
    """Return a name for each camera: what tells its topic from those of others, in letters, digits and underscores."""
    found = []
    for topic in topics:
        parts = [part for part in topic.strip("/").split("/") if part]
        while len(parts) > 1 and parts[-1] in _GENERIC:
            parts.pop()
        own = parts[-1] if parts and parts[-1] not in _GENERIC else "camera"
        found.append("".join(c if c.isalnum() else "_" for c in own))
    if len(set(found)) < len(found):
        found = ["_".join("".join(c if c.isalnum() else "_" for c in part) for part in topic.strip("/").split("/"))
                 for topic in topics]  # fmt: skip
    return found


def _comparable_times(clouds: NDArray[np.int64], images: NDArray[np.int64]) -> tuple[FloatArray, FloatArray, str]:
    """Return the times of clouds and of pictures, s, and what they are: stamps, unless these are empty or of clocks
    that have nothing to do with each other."""
    stamped = bool(len(clouds) and len(images) and clouds[:, 0].all() and images[:, 0].all())
    if stamped:
        latest_begin = max(clouds[:, 0].min(), images[:, 0].min())
        stamped = bool(latest_begin <= min(clouds[:, 0].max(), images[:, 0].max()))
    column = 0 if stamped else 1
    zero = min(clouds[:, column].min(initial=1 << 62), images[:, column].min(initial=1 << 62))
    by = "the time stamps of their headers" if stamped else "the time of recording, their headers' being of no use"
    return (clouds[:, column] - zero) / 1e9, (images[:, column] - zero) / 1e9, by


def _paired(clouds: FloatArray, images: FloatArray) -> list[_Pair]:
    """Return each cloud with the picture nearest to it within half of the shorter period; no picture serves twice."""
    if not len(clouds) or not len(images):
        return []
    periods = [float(np.median(np.diff(np.sort(times)))) for times in (clouds, images) if len(times) > 1]
    most = 0.5 * min((period for period in periods if period > 0), default=0.1)
    best: dict[int, tuple[float, int]] = {}
    for k, time in enumerate(clouds):
        apart = np.abs(images - time)
        image = int(apart.argmin())
        if apart[image] <= most and (image not in best or apart[image] < best[image][0]):
            best[image] = float(apart[image]), k
    return sorted((_Pair(k, image) for image, (_, k) in best.items()), key=lambda pair: clouds[pair.cloud])


def _spread(pairs: Sequence[_Pair], most: int) -> list[_Pair]:
    """Return at most so many pairs, evenly spread over the recording."""
    if len(pairs) <= most:
        return list(pairs)
    return [pairs[index] for index in np.unique(np.linspace(0, len(pairs) - 1, most).round().astype(int)).tolist()]


def _thumb(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return a small gray copy as a unit vector without mean: the product of two is their correlation."""
    gray = cv2.resize(pixels, _THUMB, interpolation=cv2.INTER_AREA).mean(axis=-1)
    flat = cv2.GaussianBlur(gray, (0, 0), _THUMB_BLUR_PX).ravel()
    flat = flat - flat.mean()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-9))


def _farthest_apart(thumbs: FloatArray, most: int) -> list[int]:
    """Return the indices of copies that correlate least with each other, ascending.

    Source: Gonzalez, Clustering to minimize the maximum intercluster distance (1985).
    """
    chosen = [0]
    nearest = thumbs @ thumbs[0]
    while len(chosen) < min(most, len(thumbs)):
        nearest[chosen] = np.inf
        index = int(nearest.argmin())
        chosen.append(index)
        nearest = np.maximum(nearest, thumbs @ thumbs[index])
    return sorted(chosen)


def _extent(times: FloatArray) -> str:
    return f"{len(times)} from {times.min():.2f} to {times.max():.2f} s"
