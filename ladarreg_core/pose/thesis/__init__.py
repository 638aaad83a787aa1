"""The pose estimators of the thesis (1998): linear, stereo residuals, downhill simplex."""
