"""Finding where the photo was taken: hypotheses, direct alignment, verification."""
