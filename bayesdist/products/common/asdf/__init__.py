"""Distortion reference files in ASDF: transforms from pixels to V2, V3 with their covariance.

The formats of JWST and Roman differ only in the tree around the transform.
"""
