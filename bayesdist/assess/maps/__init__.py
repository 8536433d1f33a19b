"""Maps over the detector: uncertainty of positions, area of pixels."""
