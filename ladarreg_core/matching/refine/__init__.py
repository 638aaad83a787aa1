"""A pose refined by the agreement of blocks, and its covariance."""
