"""Self-calibration: distortion, exposures' frames and stars' positions from detections alone.

The stars' parameters are eliminated star by star, so that nothing is dense in their number; what
is left are the parameters of a `DistortionModel`.
"""
