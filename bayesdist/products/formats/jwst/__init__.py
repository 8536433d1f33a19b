"""Distortion reference files of JWST's imagers: ASDF, as stdatamodels' DistortionModel has them."""
