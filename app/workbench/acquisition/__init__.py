"""Devices that a page drives, and runs that it watches."""
