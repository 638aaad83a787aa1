"""The scanned surface: views, mesh, visibility, texture, range quality and uncertainty per cell."""
