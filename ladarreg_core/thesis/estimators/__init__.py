"""Pose estimators of the thesis (1998): the linear method, stereo residuals and the downhill simplex."""
