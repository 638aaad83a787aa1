"""Damage, floods, kills, full disks: what the product has to withstand."""
