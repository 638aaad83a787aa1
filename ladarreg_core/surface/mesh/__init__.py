"""The scan as a mesh: triangles, normals, levels of detail."""
