"""The workbench behind the page: commands in, state out."""
