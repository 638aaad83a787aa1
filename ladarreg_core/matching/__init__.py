"""Automatic registration: initial poses, direct alignment, image verification."""
