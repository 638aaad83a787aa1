"""Small valid files of every format, and checks of written ones."""
