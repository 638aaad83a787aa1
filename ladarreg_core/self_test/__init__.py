"""What to expect of a scan and a camera, tried on photographs made from the scan itself.

`made_photo` makes them, `trials` registers them, `report` says what came of it.
"""
