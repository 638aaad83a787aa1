"""How good automatic registration is, beside its peers."""
