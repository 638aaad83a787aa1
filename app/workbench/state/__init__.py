"""What pages are sent: the slices of the state, and what of it belongs to each client."""
