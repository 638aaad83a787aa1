"""Pose estimation: from matches to a camera pose with covariance, verdict and diagnostics."""
