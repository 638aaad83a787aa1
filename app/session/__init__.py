"""The document being worked on, and everything that it refers to, loaded and computed once."""
