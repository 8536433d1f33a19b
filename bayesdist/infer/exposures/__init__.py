"""Fits of single exposures, and exposure-to-exposure variation of frames and chip offsets."""
