"""Register laser scans with photographs taken from somewhere else, and know how good the result is.

Everything public is reached from here and imported when it is first used, so that `import ladarreg_core` costs
nothing.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ladarreg_core.camera import Camera as Camera
    from ladarreg_core.comparison import compare as compare
    from ladarreg_core.errors import Cancelled as Cancelled
    from ladarreg_core.errors import LadarregError as LadarregError
    from ladarreg_core.formats import read_photo as read_photo
    from ladarreg_core.formats import read_scan as read_scan
    from ladarreg_core.frames import Rigid as Rigid
    from ladarreg_core.frames import ThesisParameters as ThesisParameters
    from ladarreg_core.given import given_pose as given_pose
    from ladarreg_core.matches import Matches as Matches
    from ladarreg_core.matches import Pick as Pick
    from ladarreg_core.photo import Photo as Photo
    from ladarreg_core.pose.estimate import estimate_pose as estimate_pose
    from ladarreg_core.progress import Progress as Progress
    from ladarreg_core.progress import Step as Step
    from ladarreg_core.registration import register as register
    from ladarreg_core.results import PoseResult as PoseResult
    from ladarreg_core.results import Registration as Registration
    from ladarreg_core.scan import Scan as Scan
    from ladarreg_core.surface.perspective import View as View
    from ladarreg_core.surface.perspective import perspective_view as perspective_view

__version__ = "0.1.0"

_HOMES = {
    "Camera": "camera",
    "Cancelled": "errors",
    "LadarregError": "errors",
    "Rigid": "frames",
    "ThesisParameters": "frames",
    "Matches": "matches",
    "Pick": "matches",
    "Photo": "photo",
    "Progress": "progress",
    "Step": "progress",
    "PoseResult": "results",
    "Registration": "results",
    "Scan": "scan",
    "View": "surface.perspective",
    "perspective_view": "surface.perspective",
    "read_photo": "formats",
    "read_scan": "formats",
    "compare": "comparison",
    "register": "registration",
    "given_pose": "given",
    "estimate_pose": "pose.estimate",
}
__all__ = sorted(_HOMES)

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
