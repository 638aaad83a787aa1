"""Quality of a registration: findings, influence, conditioning, and where to add matches."""
