"""What the search compares: images of the scan and of the photograph, at several scales."""
