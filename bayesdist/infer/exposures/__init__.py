"""Exposure-to-exposure variation: frames, chip offsets, trends."""
