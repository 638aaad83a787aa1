"""Many photographs, and many jobs, in one run."""
