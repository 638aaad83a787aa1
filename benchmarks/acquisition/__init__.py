"""How good acquisition is."""
