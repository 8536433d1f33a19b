"""STDGDC: tables of every pixel, as hst1pass reads them."""
