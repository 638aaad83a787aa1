"""A project's document with picks and a pose."""

from __future__ import annotations

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import ThesisParameters
from ladarreg_core.matches import Pick
from ladarreg_core.pose.estimate import estimate_pose
from ladarreg_core.project import edits
from ladarreg_core.project.document import Document
from ladarreg_core.project.results import pose_entry
from ladarreg_core.project.source import Source
from ladarreg_core.results.registration import PoseResult

SOURCE = Source(path="photo.png", name="photo.png", size=3)


def a_pick(k: int, kind: str = "point") -> Pick:
    rng = np.random.default_rng(k)
    ends = 1 if kind == "point" else 2
    rays = rng.normal(size=(ends, 3)) + np.array([5, 0, 0])
    return Pick(str(k), kind, rays, rng.uniform(0, 99, (ends, 2)))  # type: ignore[arg-type]


def a_result(seed: int = 0) -> PoseResult:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(3, 6, 40), rng.uniform(-1.5, 1.5, (40, 2))])
    pose, camera = ThesisParameters(0.5, -0.1, 0.05, 0.1, -0.05, 0.02).pose, Camera.from_focal(640, 480, 600)
    ranges = np.linalg.norm(points, axis=1)
    uv = camera.project(pose @ points) + rng.normal(0, 0.3, (40, 2))
    uv[:5] += 80
    return estimate_pose(points / ranges[:, None], ranges, uv, camera)


def a_document(picks: int = 3) -> Document:
    document = Document(name="test", scan=Source(path="scan.npz", name="scan.npz", size=9))
    document, photo = edits.with_photo(document, SOURCE)
    return edits.edited_photo(document, photo, lambda p: edits.with_picks(p, [a_pick(k) for k in range(picks)])[0])


def with_an_answer(document: Document, seed: int = 0) -> Document:
    entry = pose_entry("robust", a_result(seed))
    return edits.edited_photo(document, document.photos[0].id, lambda p: edits.with_pose(p, entry))
