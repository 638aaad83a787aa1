"""The 3-D stage in viser: the model, the cameras, the matches and the walking simplex, drawn by one thread."""

from app.scene.actions import StageActions
from app.scene.scene import Stage3D
from app.scene.simplex_frame import SimplexFrame

__all__ = ["SimplexFrame", "Stage3D", "StageActions"]
