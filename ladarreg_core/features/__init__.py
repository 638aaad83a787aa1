"""What is found in one picture: corners, orientation channels, descriptors."""
