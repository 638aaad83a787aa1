"""The page's own files, and how they are served."""
