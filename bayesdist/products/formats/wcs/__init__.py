"""Headers with world coordinate systems, described as astropy.wcs has them."""
