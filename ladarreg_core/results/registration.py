"""Results of solvers and registrations."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ladarreg_core.camera import CameraModel, camera_from_model_fields, require_pinhole
from ladarreg_core.camera.uncertainty import CameraUncertainty, pose_jacobian
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.foundations.palette import BAD, OK, WARN
from ladarreg_core.frames import Rigid, ThesisParameters, describe_direction, describe_position, rotation_from_rotvec
from ladarreg_core.matches import Matches, count_picks
from ladarreg_core.results.compared_blocks import ComparedBlocks
from ladarreg_core.results.steps import Step
from ladarreg_core.results.verdict_words import (
    COARSE_CAVEAT,
    GIVEN_MARK,
    MATCHES_ONLY_CAVEAT,
    Evidence,
    is_determined,
    verdict_words,
)

ThesisStage = Literal["linear", "constrained_linear", "simplex", "simplex_outliers_removed"]
"""The columns of thesis Tables 3.2-3.5."""
StageName = Literal[ThesisStage, "default"]
"""The columns of a comparison: those of the thesis, and the default method."""
StageId = Literal[ThesisStage, "robust", "refined", "auto", "thesis", "survey", "carried"]
"""The poses that a project stores for a photograph."""
STAGE_LABELS: dict[StageId | StageName, str] = {
    "linear": "Linear",
    "constrained_linear": "Constrained linear",
    "simplex": "Simplex",
    "simplex_outliers_removed": "Simplex, outliers removed",
    "robust": "Robust",
    "refined": "Refined against the image",
    "auto": "Automatic",
    "thesis": "Thesis chain",
    "survey": "Survey",
    "carried": "Carried over",
    "default": "Default",
}
"""Labels of all stages, in the order in which they are listed."""
COARSE_SIGMA_PX = 3.0
"""Standard deviation above which an accepted pose is called coarse, px of a photograph of 1 megapixel."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class PoseResult:
    """A pose with its evidence, residuals and uncertainty."""

    camera_from_scanner: Rigid
    """The pose."""
    camera: CameraModel
    """Intrinsics, given or estimated."""
    matches: Matches
    """All M matches given to the solver."""
    inliers: BoolArray
    """(M,) bool."""
    residuals_px: FloatArray
    """(M, 2) photo pixels, observed minus predicted from the measured range; NaN behind the camera.

    Matches known only across a line have only that component."""
    residuals_m: FloatArray
    """(M,) errors-in-variables range residual, measured minus adjusted, m; finite at zero baseline."""
    stereo_depth_error_m: FloatArray
    """(M,) laser minus stereo depth as in the thesis, m; NaN where undefined. Source: thesis Eq 2.19-2.21."""
    covariance: FloatArray
    """(6, 6) of (w, c): R_true = exp([w]x) R_estimated (rad), c = C_true - C_estimated in the scanner frame (m).

    NaN where it is not known, as of a pose that was given."""
    world_from_scanner: Rigid | None = None
    """The scanner's pose in the world, from the scan; None: the scan's file states none."""
    chi2_per_dof: float
    """Over the inliers, with 2n - 6 degrees of freedom, minus one for each match known only across a line and
    for each intrinsic estimated; NaN: none."""
    sigma_px: float
    """Pixel noise, given or estimated."""
    sigma_range_m: float
    """Range noise, given or estimated."""
    camera_sigmas: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the estimated intrinsics: `focal_px`, `k1`, `cx`, `cy`; empty: all as given."""
    camera_uncertainty: CameraUncertainty | None = None
    """Joint uncertainty of pose and camera, of which `covariance` is the pose's part; None: the camera is exact."""
    blocks: ComparedBlocks | None = None
    """What each block of pixels says, of an automatic registration; None: not known."""
    accepted: bool = False
    """Whether the evidence suffices to present the pose as registered."""
    evidence: Evidence = "none"
    """`image`: verified against the image; `ties`: by what other photographs of a survey show of the surface;
    `statistics`: accepted on matches only; `given`: applied, not solved, and never accepted; `none`."""
    reasons: tuple[str, ...] = ()
    """Reasons of the verdict, as sentences."""
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    """Planarity, baseline, spread, why the solver stopped, and more; JSON-ready."""
    said_coarse: bool = False
    """What its file says of `is_coarse`; used where it was read without its matches."""

    def __repr__(self) -> str:
        name = type(self).__name__
        if self.accepted:
            verdict = f"{self.caveat or 'accepted'}{' by the images' if self.evidence == 'image' else ''}"
        else:
            verdict = self.mark or "not accepted"
        if not self.has_pose:
            return f"{name}({verdict}, no pose)"
        words = [verdict if self.is_shown else f"{verdict}, best guess", self.thesis_parameters.describe_position()]
        if np.isfinite(self.covariance).all():
            position_mm, angle_deg = 1000 * self.sigma_position_m, np.degrees(self.sigma_angle_rad)
            words.append(f"sigma {position_mm:.3g} mm and {angle_deg:.2g} deg")
        if len(self.matches):
            off = np.hypot(*self.residuals_px[self.inliers].T)
            rms = f", residual {np.sqrt(np.nanmean(off**2)):.2f} px rms" if np.isfinite(off).any() else ""
            words.append("{} of {} matches agree".format(*count_picks(self.matches, self.inliers)) + rms)
        return f"{name}({'; '.join(words)})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the verdict, the parameters with their sigmas, and the residuals."""
        from ladarreg_core.foundations.card import arrows, card

        good = self.accepted and self.evidence in ("image", "ties", "rig") and not self.is_coarse
        words = verdict_words(self.accepted, self.evidence, self.diagnostics, coarse=self.is_coarse)
        facts = [("matches", "{} of {} agree".format(*count_picks(self.matches, self.inliers)))]
        if self.is_determined:
            rounded = self.thesis_parameters.rounded(self.thesis_sigmas)
            facts += [(one.name, f"{one.value} \u00b1 {one.sigma} {one.unit}") for one in rounded]
            position, angle = format_length(self.sigma_position_m), format_angle(self.sigma_angle_rad)
            facts.append(("sigma", f"{position} and {angle}, over all three axes"))
        at, off = self.matches.uv, self.residuals_px
        picture = arrows(self.camera.size, at, off, self.inliers, (OK, BAD), "residuals") if len(at) else None
        verdict = words, OK if good else WARN if self.is_shown else BAD
        return card(type(self).__name__, facts, picture=picture, verdict=verdict, notes=self.reasons)

    @property
    def has_pose(self) -> bool:
        """Whether there is a candidate at all; False: the pose of this refused result is only a placeholder."""
        return not self.diagnostics.get("no_candidate")

    @property
    def is_shown(self) -> bool:
        """Whether pictures, models and exports are made of it: of an accepted pose, and, marked, of a given one."""
        return self.accepted or self.evidence == "given"

    @property
    def mark(self) -> str:
        """What every picture and file must say of a pose that was not verified; empty for an accepted one."""
        return GIVEN_MARK if self.evidence == "given" and not self.accepted else ""

    @property
    def is_coarse(self) -> bool:
        """Whether it is accepted, and known to more than `COARSE_SIGMA_PX` only, in the median over its inliers."""
        if not (self.accepted and self.inliers.any()):
            return self.accepted and self.said_coarse
        sigma_px, (width, height) = self.median_pixel_sigma(self.inliers), self.camera.size
        return bool(np.isfinite(sigma_px) and sigma_px > COARSE_SIGMA_PX * np.sqrt(width * height / 1e6))

    @property
    def caveat(self) -> str:
        """The mark, or what an accepted pose lacks: `MATCHES_ONLY_CAVEAT`, `COARSE_CAVEAT`; empty for any other one."""
        if self.accepted and self.evidence == "statistics":
            return MATCHES_ONLY_CAVEAT + (", coarse" if self.is_coarse else "")
        return self.mark or (COARSE_CAVEAT if self.is_coarse else "")

    @property
    def standing(self) -> str:
        """What a file says of its pose: accepted, how precisely and on what evidence, or else its mark."""
        if not self.accepted:
            return self.mark or "not accepted"
        return self.caveat if self.evidence == "statistics" else f"{self.caveat or 'accepted'} ({self.evidence})"

    @property
    def joint_covariance(self) -> FloatArray | CameraUncertainty | None:
        """The uncertainty to propagate into pixels: with the camera's, if there is one; else the pose's.

        None for a pose that was given: its uncertainty is not known, so no cell is uncertain because of it.
        """
        if self.evidence == "given" and not np.isfinite(self.covariance).all():
            return None
        return self.covariance if self.camera_uncertainty is None else self.camera_uncertainty

    def pixel_jacobian(self, points_scanner: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return uv (N, 2) as `pose_jacobian`, and J (N, 2, 6 + K) by the pose and the uncertain intrinsics."""
        pose, camera = self.camera_from_scanner, self.camera
        uv, J = pose_jacobian(pose, points_scanner, camera)
        if self.camera_uncertainty is None:
            return uv, J
        p = pose @ np.asarray(points_scanner, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = p[..., :2] / np.where(p[..., 2:] > 0, p[..., 2:], np.nan)
        by_camera = self.camera_uncertainty.jacobian(require_pinhole(camera, "Its uncertainty"), xy)
        return uv, np.concatenate([J, by_camera], axis=-1)

    def median_pixel_sigma(self, matches: BoolArray) -> float:
        """Return the median standard deviation of the pixels of some matches (M,) bool, px, as far as pose and camera
        determine them; infinite without a covariance."""
        _, J = self.pixel_jacobian(self.matches.points[matches])
        J = J[np.isfinite(J).all(axis=(1, 2))]
        if not len(J) or not np.isfinite(self.covariance).all():
            return float("inf")
        joint = self.camera_uncertainty
        variance = np.einsum("nij,jk,nik->n", J, self.covariance if joint is None else joint.covariance, J)
        return float(np.sqrt(max(float(np.median(variance)), 0.0)))

    @property
    def camera_from_world(self) -> Rigid | None:
        """The pose in the world; None where the scanner's is not known."""
        world = self.world_from_scanner
        return None if world is None else self.camera_from_scanner @ world.inverse

    @property
    def camera_centre_world(self) -> FloatArray | None:
        """The camera's centre (3,) in the world, m, float64; None where the scanner's pose is not known."""
        world = self.world_from_scanner
        return None if world is None else world @ self.camera_from_scanner.centre

    @property
    def in_world(self) -> str | None:
        """Where the camera stands in the world and looks, as text; None where the scanner's pose is not known."""
        pose, centre = self.camera_from_world, self.camera_centre_world
        if pose is None or centre is None:
            return None
        return f"{describe_position(centre)}; the camera looks {describe_direction(pose.rotation[2])}"

    @property
    def thesis_parameters(self) -> ThesisParameters:
        """Tx, Ty, Tz (m) and alpha, beta, gamma (rad) of thesis 2.4."""
        return ThesisParameters.from_pose(self.camera_from_scanner)

    @property
    def thesis_sigmas(self) -> ThesisParameters:
        """Standard deviations of the thesis's parameters (m, rad), propagated from the covariance to first order."""
        pose, steps = self.camera_from_scanner, 1e-6 * np.eye(6)
        columns = [_parameters(_perturbed(pose, d)) - _parameters(_perturbed(pose, -d)) for d in steps]
        J = np.stack(columns, axis=1) / 2e-6
        return ThesisParameters(*np.sqrt(np.diag(J @ self.covariance @ J.T)).tolist())

    @property
    def sigma_angle_rad(self) -> float:
        """Standard deviation of the rotation, root sum of squares over its three axes, rad."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_position_m(self) -> float:
        """Standard deviation of the camera centre, root sum of squares over its three axes, m."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def is_determined(self) -> bool:
        """Whether the numbers of the pose mean anything; those of a refused placeholder or a guess do not."""
        if self.is_shown:
            return True
        if len(self.matches) and not self.inliers.any():
            return False
        return is_determined(self.sigma_angle_rad, self.sigma_position_m, self.matches.ranges)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Registration(PoseResult):
    """A pose with the steps that led to it."""

    method: str
    """`auto`, `thesis`, `manual`, `carried` or `given`."""
    steps: tuple[Step, ...] = ()
    """Every step, in order."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The options used, JSON-ready."""
    seed: int = 0
    """The seed used."""

    @property
    def untimed(self) -> Registration:
        """This registration without the times of its steps: what else there is does not differ from run to run."""
        return replace(self, steps=tuple(replace(step, seconds=float("nan")) for step in self.steps))

    def to_json(self) -> str:
        """Return the result as JSON; the names and meanings are those of `registration.json`.

        Steps and diagnostics are left out. `export_registration` writes the complete document, which also states the
        inputs, the options and an assessment.
        """
        pose = self.camera_from_scanner.matrix.tolist() if self.has_pose else None
        world = self.world_from_scanner
        m = self.matches
        fields = {
            "camera_from_scanner": pose if self.is_shown else None,
            "rejected_guess": None if self.is_shown else pose,
            "world_from_scanner": None if world is None else world.matrix.tolist(),
            "camera": self.camera.as_fields(),
            "camera_sigmas": dict(self.camera_sigmas),
            "camera_uncertainty": None if self.camera_uncertainty is None else self.camera_uncertainty.as_fields(),
            "covariance": self.covariance.tolist() if np.isfinite(self.covariance).all() else None,
            "sigma": {"pixel_px": self.sigma_px, "range_m": self.sigma_range_m, "chi2_per_dof": self.chi2_per_dof},
            "accepted": bool(self.accepted),
            "evidence": self.evidence,
            "reasons": list(self.reasons),
            "matches": [
                {
                    "pick_id": pick_id,
                    "inlier": bool(self.inliers[k]),
                    **{name: column[k].tolist() for name, column in self._match_columns(m).items()},
                }
                for k, pick_id in enumerate(m.pick_ids)
            ],
            "blocks": None if self.blocks is None else self.blocks.as_fields(),
            "method": self.method,
            "seed": self.seed,
        }
        return json.dumps(_without_nan(fields), allow_nan=False)

    def _match_columns(self, matches: Matches) -> dict[str, FloatArray]:
        columns = (matches.rays, matches.ranges, matches.uv, matches.weights, matches.range_weights)
        own = (self.residuals_px, self.residuals_m, self.stereo_depth_error_m)
        return dict(zip(_MATCH_FIELDS, (*columns, *own), strict=True))

    @staticmethod
    def from_json(text: str) -> Registration:
        """Return the result that `to_json` wrote; `read_registration` reads files.

        Raises:
            ShapeError: if the text is not such JSON, or a number in it is invalid.
            LadarregError: if its pose or camera is impossible.
        """
        try:
            fields = json.loads(text)
            pose = fields["camera_from_scanner"] or fields["rejected_guess"]
            world, joint = fields["world_from_scanner"], fields["camera_uncertainty"]
            found = fields["matches"]
            columns = {
                name: np.array([_with_nan(one[name]) for one in found], np.float64).reshape(-1, *tail)
                for name, tail in _MATCH_FIELDS.items()
            }
            covariance = fields["covariance"]
            return Registration(
                camera_from_scanner=Rigid.identity() if pose is None else Rigid.from_matrix(pose),
                camera=camera_from_model_fields(fields["camera"]),
                matches=Matches(
                    columns["ray"], columns["range_m"], columns["uv"], [one["pick_id"] for one in found],
                    weights=columns["weight"], range_weights=columns["range_weight"],
                ),
                inliers=np.array([one["inlier"] for one in found], np.bool_),
                residuals_px=columns["residual_px"],
                residuals_m=columns["residual_m"],
                stereo_depth_error_m=columns["stereo_depth_error_m"],
                covariance=np.full((6, 6), np.nan) if covariance is None else np.array(covariance, np.float64),
                world_from_scanner=None if world is None else Rigid.from_matrix(world),
                chi2_per_dof=_with_nan(fields["sigma"]["chi2_per_dof"]),
                sigma_px=fields["sigma"]["pixel_px"],
                sigma_range_m=fields["sigma"]["range_m"],
                camera_sigmas=fields["camera_sigmas"],
                camera_uncertainty=None if joint is None else CameraUncertainty.from_fields(joint),
                blocks=None if fields.get("blocks") is None else ComparedBlocks.from_fields(fields["blocks"]),
                accepted=fields["accepted"] is True,
                evidence=fields["evidence"],
                reasons=tuple(fields["reasons"]),
                diagnostics={} if pose is not None else {"no_candidate": True},
                method=fields["method"],
                seed=fields["seed"],
            )  # fmt: skip
        except (ValueError, KeyError, TypeError, AttributeError, IndexError):
            raise ShapeError("the text is not a registration; give what `to_json` of a Registration returned") from None


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """One column of the thesis's tables: the result of an estimator, or why there is none."""

    name: StageName
    """Estimator and matches used."""
    result: PoseResult | None
    """Its result with the matches used; None if there is none."""
    note: str = ""
    """A sentence on the outcome, or on why there is no result."""


_MATCH_FIELDS: dict[str, tuple[int, ...]] = {
    "ray": (3,), "range_m": (), "uv": (2,), "weight": (), "range_weight": (),
    "residual_px": (2,), "residual_m": (), "stereo_depth_error_m": (),
}  # fmt: skip


def _without_nan(value: Any) -> Any:
    """Return JSON values with null for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _with_nan(value: Any) -> Any:
    """Return a number or a list of numbers with NaN for null."""
    if isinstance(value, list):
        return [_with_nan(item) for item in value]
    return float("nan") if value is None else float(value)


def _perturbed(pose: Rigid, change: FloatArray) -> Rigid:
    """Return the pose rotated by exp([w]x) and with its centre moved by c."""
    return Rigid.from_centre(rotation_from_rotvec(change[:3]) @ pose.rotation, pose.centre + change[3:])


def _parameters(pose: Rigid) -> FloatArray:
    p = ThesisParameters.from_pose(pose)
    return np.array([p.Tx, p.Ty, p.Tz, p.alpha, p.beta, p.gamma])
