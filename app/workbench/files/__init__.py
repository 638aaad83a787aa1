"""Files that are opened: uploads, served folders, and what is asked about them."""
