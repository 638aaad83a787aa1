"""What is read off a registered scan: measurements, rectified views and sections, and change between dates."""
