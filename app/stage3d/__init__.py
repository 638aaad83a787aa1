"""The 3-D stage in viser: the model, the cameras, the matches and the walking simplex, drawn by one thread."""

from app.stage3d.actions import StageActions
from app.stage3d.simplex_frame import SimplexFrame
from app.stage3d.stage import Stage3D

__all__ = ["SimplexFrame", "Stage3D", "StageActions"]
