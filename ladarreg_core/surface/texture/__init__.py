"""Colors on the surface: labels, textures, and the model of photographs."""
