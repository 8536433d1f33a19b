"""Errors of the reference catalogue and of the detections: by star, by magnitude, by group."""
