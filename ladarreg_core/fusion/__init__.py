"""One coloured model from many photographs and sensors: exposure, moved things, seams, layers with units."""
