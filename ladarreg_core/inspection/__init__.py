"""Inspection: pictures of the scan, overlays, residuals of picks and their predicted counterparts, textures of the
model."""
