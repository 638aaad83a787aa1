"""What a person sees of the core: the command line and the viewer. No mathematics lives here."""
