"""`fit_target`: the centre of a survey target in a scan."""

from __future__ import annotations

from ladarreg_core.errors import OptionError
from ladarreg_core.registration.stations.flat_targets import fit_flat_target
from ladarreg_core.registration.stations.sphere_targets import fit_sphere
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.scan import Scan


def fit_target(
    scan: Scan, pick: tuple[int, int], *, radius_m: float | None = None, side_m: float | None = None
) -> SurveyTarget:
    """Fit a sphere of known radius, or a flat target of four quadrants, to the cells around a pick.

    The ranges of a sphere are compared with those at which each ray meets it, so that a sphere seen from one side only
    is not drawn toward the scanner. Which cells are used follows from their rays and not from their ranges; the rim,
    where a beam also meets what is behind, is left out.

    A flat target has two bright quadrants opposite each other and two dark ones, as an inner corner of a checkerboard
    does. Its middle follows from the intensities where the rays meet its plane.

    Args:
        scan: the scan; with intensities for flat targets.
        pick: row and column of a cell on the sphere, or within a third of the side of a flat target's middle.
        radius_m: radius of the sphere, m.
        side_m: side of the four quadrants together, m.

    Returns:
        the center with its covariance, from the scatter of ranges and intensities about the target.

    Raises:
        OptionError: if an argument is of a wrong type, the pick is outside of the scan, or not one of `radius_m` and
            `side_m` is given.
        DegenerateGeometryError: if the pick has no return, or there is no such target around it.
    """
    if radius_m is not None and side_m is None:
        return fit_sphere(scan, pick, radius_m=radius_m)
    if side_m is not None and radius_m is None:
        return fit_flat_target(scan, pick, side_m=side_m)
    raise OptionError("a target is a sphere or flat; give either its radius or its side", field="radius_m")
