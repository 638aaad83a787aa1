"""What a camera sees of the surface."""
