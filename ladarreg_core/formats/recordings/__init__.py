"""Recordings of ROS: what they hold, and their pictures."""
