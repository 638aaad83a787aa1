"""The command line and the browser workbench, around the library `ladarreg_core`; no mathematics here."""
