"""Labels of registration steps, as shown to users; the names themselves are stored in `registration.json`."""

from __future__ import annotations

from collections.abc import Mapping

STEP_LABELS: Mapping[str, str] = {
    "photo": "Prepare photo",
    "channels": "Compute channels",
    "hypothesis": "Pose hypothesis",
    "climb": "Refine candidate",
    "places": "Grid search",
    "turn": "Detect roll",
    "faces": "Cut out faces",
    "all faces": "Refine on all faces",
    "finish": "Final refinement",
    "verify": "Image verification",
    "camera": "Self-calibration",
    "wrong poses": "Compare with wrong poses",
    "evidence": "Uncertainty",
    "second minimum": "Ambiguity check",
    "modality": "Select channels",
    "corners": "Find corners",
    "unconstrained search": "Match corners",
    "disparity culling": "Disparity filter",
    "linear": "Linear pose",
    "robust first pose": "Robust initial pose",
    "constrained search": "Guided matching",
    "constrained linear": "Linear pose, guided matches",
    "lines between matches": "Lines between matches",
    "simplex": "Simplex",
    "outliers removed": "Simplex, outliers removed",
    "matches": "Matches from picks",
    "pose": "Solve pose",
    "starts": "Multi-start check",
    "image check": "Compare with the images",
    "result": "Result",
    "rig pair": "Register pair",
    "rig candidates": "Try on all pairs",
    "rig finish": "Refine on all pairs",
    "rig held out": "Hold out each pair",
    "rig time offset": "Time offset",
    "rig covariance": "Uncertainty of the rig",
}
"""Label of each step name."""


def step_label(name: str) -> str:
    """Return the label of a step; a name without one is returned as it is."""
    return STEP_LABELS.get(name, name)
