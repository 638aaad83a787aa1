"""The textured model in the formats of models."""
