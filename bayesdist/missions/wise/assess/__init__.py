"""Residual tables and distortion fields of the WISE report (WSDC D-T033), compared with runs."""
