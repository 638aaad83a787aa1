"""Image features: corners, orientation channels, descriptors, and their correlation."""
