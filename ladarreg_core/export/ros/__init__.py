"""ROS messages in MCAP files."""
