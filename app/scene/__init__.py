"""The 3-D scene in viser: the cameras, the matches and the moving simplex of each client, drawn by one thread."""

from .measured_layer import MeasuredShown
from .person import Person
from .picks_layer import Picks, residual_colors
from .scene import Scene3D, Shown
from .simplex_frame import SimplexFrame
from .smoothing_layer import SmoothingShown
from .stations_layer import StationShown
from .subject import CameraShown, ScanShown, Subject
from .survey_layer import SurveyShown

__all__ = [
    "CameraShown",
    "MeasuredShown",
    "Person",
    "Picks",
    "ScanShown",
    "Scene3D",
    "Shown",
    "SimplexFrame",
    "SmoothingShown",
    "StationShown",
    "Subject",
    "SurveyShown",
    "residual_colors",
]
