"""The commands of a page, a struct each."""
