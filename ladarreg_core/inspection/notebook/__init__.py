"""What notebooks show: progress, and pictures as arrays and figures."""
