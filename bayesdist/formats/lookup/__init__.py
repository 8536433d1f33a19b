"""D2IMFILE and NPOLFILE: look-up tables of HST instruments."""
