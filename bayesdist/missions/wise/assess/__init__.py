"""Residual tables and fields of the WISE report (WSDC D-T033), printed and measured."""
