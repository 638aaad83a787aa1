"""A workbench that is served, and those who use it: websocket clients, browsers, an operator."""
