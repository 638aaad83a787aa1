"""How fast the parts are, beside their peers."""
