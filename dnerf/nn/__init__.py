"""Small networks and encodings that fields and deformations share."""
