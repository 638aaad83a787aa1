"""What every package rests on: markup and encoded images."""
