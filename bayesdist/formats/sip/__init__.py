"""SIP headers: distortion as FITS keywords."""
