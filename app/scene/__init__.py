"""The 3-D scene in viser: the model, the cameras, the matches and the moving simplex, drawn by one thread."""

from .actions import SceneActions
from .scene import Scene3D
from .simplex_frame import SimplexFrame

__all__ = ["Scene3D", "SceneActions", "SimplexFrame"]
