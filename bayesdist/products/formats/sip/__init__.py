"""SIP header: a distortion as FITS keywords."""
