"""Many photographs in one run: worker processes, a cache on disk, a journal that makes a run resumable, its summary."""
