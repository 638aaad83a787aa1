"""What Potree reads: an octree of points, and photographs that stand in it."""
