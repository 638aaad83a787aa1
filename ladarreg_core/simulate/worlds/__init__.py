"""Simulated worlds: rooms, outdoors, materials and textures."""
