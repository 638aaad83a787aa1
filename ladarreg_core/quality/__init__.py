"""Quality of a registration: findings, influence, conditioning, uncertainty and suggestions for the next match."""
