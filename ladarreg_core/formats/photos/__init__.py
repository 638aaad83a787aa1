"""Pictures and what their metadata states."""
