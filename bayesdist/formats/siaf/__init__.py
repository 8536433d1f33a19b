"""Coefficient tables of the Science Instrument Aperture File (SIAF), as read by pysiaf."""
