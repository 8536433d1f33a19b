"""Errors of the reference catalogue (per star) and of the detections (by magnitude or group)."""
