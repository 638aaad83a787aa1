"""Pictures, poses and colors written into E57 files."""
