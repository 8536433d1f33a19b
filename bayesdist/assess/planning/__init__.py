"""Planning of further exposures: their number, and the best dithers."""
