"""A scan registered with photographs: one, several of a rig, and scans with one another."""
