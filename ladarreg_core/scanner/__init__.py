"""Scanner geometries: rays of cells, gridding of clouds, pan/tilt units."""
