"""STDGDC: tables with a value for every pixel, as read by hst1pass."""
