"""The open document and everything that it refers to, loaded and computed once."""
