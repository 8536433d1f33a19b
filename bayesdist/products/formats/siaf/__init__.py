"""Coefficient tables of the Science Instrument Aperture File (SIAF), as pysiaf reads them."""
