"""The least-squares problem of bodies, cameras and ties, and its robust solution with covariances."""
