"""The workbench behind the page: takes commands, publishes state."""
