"""Distortion reference files in ASDF: a transform from pixels to V2, V3, with our covariance.

Formats of JWST and of Roman differ in the tree around that transform, and share all else.
"""
