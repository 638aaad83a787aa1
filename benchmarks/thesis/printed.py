"""Values printed in Tables 3.1 to 3.5 of the thesis: one run each."""

from __future__ import annotations

from dataclasses import dataclass

Six = tuple[float, float, float, float, float, float]
"""Tx, Ty, Tz (m, or the apple's units) and alpha, beta, gamma (deg)."""

APPLE_BEFORE: Six = (4.8540, 1.9464, 1.9099, 24.4575, 9.8894, 5.5486)
"""Table 3.1, all points."""
APPLE_AFTER: Six = (4.9986, 2.0219, 1.9792, 25.1758, 10.1563, 4.9148)
"""Table 3.1, outliers rejected."""
APPLE_BEFORE_PERCENT: Six = (-2.9204, -2.6790, -4.5038, -2.1699, -1.1058, 10.9712)
APPLE_AFTER_PERCENT: Six = (-0.0279, 1.0961, -1.0380, 0.7034, 1.5632, -1.7039)
APPLE_POINTS = (208, 189)
"""Number of points before and after rejection."""


def mean_percent(errors: Six) -> float:
    """Return the mean |error| over the six parameters."""
    return sum(abs(e) for e in errors) / 6


@dataclass(frozen=True)
class PrintedScene:
    """One of Tables 3.2 to 3.5; the stages are unconstrained, constrained, simplex, and simplex without outliers."""

    table: str
    points: tuple[int, int, int, int]
    stages: tuple[Six, Six, Six, Six]


SCENES = {
    "boxes": PrintedScene(
        "3.2",
        (28, 36, 36, 31),
        (
            (0.0989, -0.1015, 0.0904, 0.7194, -2.1800, 0.1998),
            (0.3446, -0.1078, 0.0664, 3.6413, -2.1612, 0.8377),
            (0.4048, -0.1419, -0.1049, 4.2448, -2.5339, 0.9051),
            (0.4932, -0.1359, 0.0318, 5.5787, -2.5381, 1.0446),
        ),
    ),
    "desk": PrintedScene(
        "3.3",
        (28, 115, 115, 110),
        (
            (0.5004, 0.3140, -0.2528, 5.4241, 3.7478, 0.6745),
            (0.4342, -0.0778, 0.0491, 5.1634, -0.2482, 0.8267),
            (0.5910, -0.1516, -0.0156, 6.8101, -1.0173, 0.3715),
            (0.5506, -0.1603, -0.0053, 6.4787, -1.1156, 0.3594),
        ),
    ),
    "office": PrintedScene(
        "3.4",
        (27, 51, 51, 48),
        (
            (0.2284, 0.2434, -0.3589, 2.4358, 2.7364, 1.0095),
            (0.6155, -0.0218, -0.0757, 6.1413, -0.0165, 0.6307),
            (0.8908, 0.0807, 0.1483, 9.8081, 1.2778, 0.2151),
            (0.9232, 0.0614, 0.1881, 10.4157, 1.0500, 0.1669),
        ),
    ),
    "people": PrintedScene(
        "3.5",
        (35, 74, 74, 72),
        (
            (0.5976, -0.1365, -0.0031, 7.0043, -0.8700, -0.1393),
            (0.4228, -0.1950, -0.0496, 5.2582, -1.5109, 0.2048),
            (0.4614, -0.1124, -0.0151, 5.6630, -0.6447, 0.1454),
            (0.4618, -0.1120, -0.0121, 5.6669, -0.6435, 0.1759),
        ),
    ),
}
