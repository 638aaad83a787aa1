"""Straight lines drawn by hand in several photographs: their initial places in the adjustment, or why they have none.

The infinite line is meant: the ends that are drawn in one photograph need not be those of another. Each photograph
sees it in a plane through its camera. Two planes always meet in a line and do not constrain the poses; the third one,
or the line as a scan shows it, does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.survey.least_squares.line_residuals import line_residuals, nearest_to_rays
from ladarreg_core.survey.least_squares.problem import Lines, Matrix, Problem
from ladarreg_core.survey.ties.ties import FAR_PX, MIN_PARALLAX_RAD

MIN_PHOTOS = 3
"""Photographs of a line that no scan shows."""
_MAX_PAIRS = 66  # of planes that are tried as a start: those of twelve photographs
_MIN_LENGTH_RAD = 1e-9  # between the rays of both ends
_MIN_APART_M = 0.01  # of the two points that stand for a line


@dataclass(frozen=True, slots=True, eq=False)
class DrawnLine:
    """A line that was drawn, as the adjustment numbers photographs and scans."""

    photos: tuple[int, ...]
    uv: Matrix
    """(n, 2, 2) its ends in each, px."""
    sigma_px: float
    scan: int = -1
    """The scan that shows it; -1: none."""
    xyz: Matrix | None = None
    """(2, 3) two places of it in the scanner's frame, m."""
    sigma_m: float = float("nan")
    """Standard deviation of these across the line."""

    @property
    def is_in_scan(self) -> bool:
        """Whether it was drawn in a scan."""
        return self.scan >= 0


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Where a line starts."""

    points: Matrix
    """(2, 3) world."""
    kept: tuple[int, ...]
    """Which of the photographs show it there."""


def lines_between(
    problem: Problem, drawn: Sequence[DrawnLine], body_of_photo: Mapping[int, int], body_of_scan: Sequence[int]
) -> Lines:
    """Return the lines that photographs of the problem show, from its present poses; those that cannot start are none.

    Args:
        problem: the problem; its lines do not count.
        drawn: all that were drawn.
        body_of_photo: index of each photograph that is part of the problem.
        body_of_scan: index of each scan, -1: it is no part of it.
    """
    starts = [(number, one, start_or_reason(problem, one, body_of_photo, body_of_scan)[0])
              for number, one in enumerate(drawn)]  # fmt: skip
    return _together([
        _of_one(problem, number, one, start, body_of_photo, body_of_scan)
        for number, one, start in starts if start is not None
    ])  # fmt: skip


def start_or_reason(
    problem: Problem, drawn: DrawnLine, body_of_photo: Mapping[int, int], body_of_scan: Sequence[int]
) -> tuple[_Start | None, str]:
    """Return where a line starts, or why it does not, as a sentence; arguments as of `lines_between`."""
    own = [k for k, photo in enumerate(drawn.photos) if photo in body_of_photo]
    scan = body_of_scan[drawn.scan] if drawn.is_in_scan else -1
    if len(own) < (1 if scan >= 0 else MIN_PHOTOS):
        return None, _too_few(len(own))
    normals, centres = _planes(problem, drawn, [(k, body_of_photo[drawn.photos[k]]) for k in own])
    if not np.isfinite(normals).all():
        return (
            None,
            "Left out: in one of its photographs it has no length, or an end lies outside the field of view.",
        )
    candidates = []
    if scan >= 0 and drawn.xyz is not None:
        first, second = problem.poses[scan].inverse @ drawn.xyz
        candidates.append((first, second - first))
    pairs, apart = _pairs(normals)
    if not candidates and apart < MIN_PARALLAX_RAD:
        return None, (
            f"Left out: its photographs see it in nearly the same plane ({np.degrees(apart):.1f} degrees apart, "
            f"{np.degrees(MIN_PARALLAX_RAD):.0f} are needed), as where it points from one camera to the other; draw it "
            "in a photograph from beside it."
        )
    if apart >= MIN_PARALLAX_RAD:
        candidates += [_common_line(normals[list(rows)], centres[list(rows)]) for rows in (range(len(own)), *pairs)]
    start = _best(problem, drawn, own, candidates, body_of_photo)
    if start is None or len(start.kept) < (1 if scan >= 0 else MIN_PHOTOS):
        return None, (
            "Left out: with the present poses its photographs do not show the same line: one of them shows another "
            "edge; draw it again."
        )
    return start, ""


def _too_few(count: int) -> str:
    shown = {
        0: "none of its photographs is part",
        1: "only one of its photographs is part",
        2: "only two of its photographs are part",
    }[count]
    return (
        f"Left out: {shown} of the adjustment, and two or fewer do not constrain their poses; draw it in "
        f"{MIN_PHOTOS} or more, or mark its ends as ties where two photographs show both."
    )


def _planes(problem: Problem, drawn: DrawnLine, own: Sequence[tuple[int, int]]) -> tuple[Matrix, Matrix]:
    """Return the unit normals (n, 3) of the planes in which photographs see a line, and their centres (n, 3)."""
    normals, centres = [], []
    for k, body in own:
        pose = problem.poses[body]
        first, second = problem.camera_of(body).unproject(drawn.uv[k]) @ pose.rotation
        normal = np.cross(first, second)
        length = float(np.linalg.norm(normal))
        normals.append(normal / length if length > _MIN_LENGTH_RAD else np.full(3, np.nan))
        centres.append(pose.centre)
    return np.array(normals), np.array(centres)


def _pairs(normals: Matrix) -> tuple[list[tuple[int, int]], float]:
    """Return pairs of planes that meet at an angle, the largest first, and that angle, rad."""
    angles = {
        (i, j): float(np.arcsin(min(float(np.linalg.norm(np.cross(normals[i], normals[j]))), 1.0)))
        for i, j in combinations(range(len(normals)), 2)
    }
    order = sorted(angles, key=lambda pair: (-angles[pair], pair))
    wide = [pair for pair in order if angles[pair] >= MIN_PARALLAX_RAD]
    return wide[:_MAX_PAIRS], angles[order[0]] if order else 0.0


def _common_line(normals: Matrix, centres: Matrix) -> tuple[FloatArray, FloatArray]:
    """Return a point and the direction of the line that lies nearest to planes through centres."""
    middle = centres.mean(axis=0)
    _, _, axes = np.linalg.svd(normals)
    across = axes[:2].T  # of the line; a third plane would not meet it in a point
    heights = np.einsum("ni,ni->n", normals, centres - middle)
    point = middle + across @ np.linalg.lstsq(normals @ across, heights, rcond=None)[0]
    return point, axes[2]


def _best(
    problem: Problem, drawn: DrawnLine, own: Sequence[int],
    candidates: Sequence[tuple[FloatArray, FloatArray]], body_of_photo: Mapping[int, int],
) -> _Start | None:  # fmt: skip
    """Return the candidate, a point and a direction, that lies nearest to the drawn ends; None: all of them behind."""
    photos = [body_of_photo[drawn.photos[k]] for k in own]
    allowed = np.array([FAR_PX * problem.camera_of(body).width / 1000 for body in photos])
    best: tuple[float, _Start] | None = None
    for point, direction in candidates:
        points = _ends(problem, drawn, own, photos, point, direction / np.linalg.norm(direction))
        if points is None:
            continue
        tried = _observed(0, points, drawn, own, photos)
        off = np.nan_to_num(np.abs(line_residuals(replace(problem, lines=tried))[0]).max(axis=1), nan=np.inf)
        score = float(np.minimum(off, allowed).sum())
        if best is None or score < best[0] - 1e-9:
            best = score, _Start(points, tuple(k for k, near in zip(own, off <= allowed, strict=True) if near))
    return None if best is None else best[1]


def _ends(
    problem: Problem, drawn: DrawnLine, own: Sequence[int], photos: Sequence[int], point: FloatArray,
    direction: FloatArray,
) -> Matrix | None:  # fmt: skip
    """Return two points of a line (2, 3) between which all drawn ends lie; None: all of them are behind the cameras."""
    places = []
    for k, body in zip(own, photos, strict=True):
        pose = problem.poses[body]
        rays, count = problem.camera_of(body).unproject(drawn.uv[k]), len(drawn.uv[k])
        there, toward = np.tile(pose @ point, (count, 1)), np.tile(pose.rotation @ direction, (count, 1))
        at = nearest_to_rays(rays, there, toward)
        places += at[np.isfinite(at)].tolist()
    if not places:
        return None
    first, second = min(places), max(max(places), min(places) + _MIN_APART_M)
    return np.array([point + first * direction, point + second * direction])


def _observed(number: int, points: Matrix, drawn: DrawnLine, kept: Sequence[int], photos: Sequence[int]) -> Lines:
    """Return one line as photographs show it."""
    count = len(kept)
    return replace(
        Lines.none(), points=points[None], line=np.zeros(count, np.int64), photo=np.array(photos, np.int64),
        uv=drawn.uv[list(kept)], sigma_px=np.full(count, drawn.sigma_px), drawn=np.array([number]),
    )  # fmt: skip


def _of_one(
    problem: Problem, number: int, drawn: DrawnLine, start: _Start, body_of_photo: Mapping[int, int],
    body_of_scan: Sequence[int],
) -> Lines:  # fmt: skip
    """Return one line as photographs and a scan show it."""
    found = _observed(number, start.points, drawn, start.kept, [body_of_photo[drawn.photos[k]] for k in start.kept])
    scan = body_of_scan[drawn.scan] if drawn.is_in_scan else -1
    if scan < 0 or drawn.xyz is None:
        return found
    along = drawn.xyz[1] - drawn.xyz[0]
    across = np.linalg.svd(along[None])[2][1:]
    points = problem.poses[scan] @ start.points
    length = points[1] - points[0]
    at = (drawn.xyz - points[0]) @ length / (length @ length)
    count = 2 * len(at)
    return replace(
        found, on_line=np.zeros(count, np.int64), at=np.repeat(at, 2), scan=np.full(count, scan),
        xyz=np.repeat(drawn.xyz, 2, axis=0), normal=np.tile(across, (2, 1)), sigma_m=np.full(count, drawn.sigma_m),
    )  # fmt: skip


def _together(lines: Sequence[Lines]) -> Lines:
    """Return lines one after the other."""
    if not lines:
        return Lines.none()
    before = np.cumsum([0, *(len(one.points) for one in lines)])[:-1]
    moved = [replace(one, line=one.line + at, on_line=one.on_line + at) for one, at in zip(lines, before, strict=True)]
    return Lines(*(
        np.concatenate([getattr(one, name) for one in moved])
        for name in ("points", "line", "photo", "uv", "sigma_px", "on_line", "at", "scan", "xyz", "normal", "sigma_m",
                     "drawn")
    ))  # fmt: skip
