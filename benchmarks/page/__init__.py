"""How the page draws, snaps, and works over a slow link."""
