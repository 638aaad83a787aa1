"""What several photographs show: features, matches between two, and ties of them all on the laser's surface."""
