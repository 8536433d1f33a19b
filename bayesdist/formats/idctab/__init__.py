"""IDCTAB: the distortion table of HST instruments."""
