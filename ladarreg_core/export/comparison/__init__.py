"""Several registrations of one pair beside one another."""
