"""Where the camera was: from matches to a pose and its uncertainty."""
