"""Self-test: expected accuracy of a scan and a camera, from synthetic photographs of the scan itself.

`synthetic_photo` renders them, `trials` registers them, `report` summarises the results.
"""
