"""The 3-D stage in viser: the model, the cameras, the matches and the walking simplex, drawn by one thread."""

from .actions import StageActions
from .scene import Stage3D
from .simplex_frame import SimplexFrame

__all__ = ["SimplexFrame", "Stage3D", "StageActions"]
