"""A project on disk: journal, snapshot, replay and rescue."""
