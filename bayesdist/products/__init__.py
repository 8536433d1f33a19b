"""Calibration files that pipelines read, each with its uncertainty: written, read, and checked."""

from bayesdist.products.idctab import IdcTab, read_idctab, write_idctab
from bayesdist.products.idctab_build import idctab_from_solution
from bayesdist.products.idctab_lint import lint_idctab
from bayesdist.products.inspect import describe, describe_idctab, describe_sip
from bayesdist.products.lint import Finding
from bayesdist.products.sip import SipHeader
from bayesdist.products.sip_build import sip_from_solution
from bayesdist.products.sip_inverse import worst_closure
from bayesdist.products.sip_lint import lint_sip
from bayesdist.products.sip_read import read_sip
from bayesdist.products.sip_write import sip_header, write_sip

__all__ = [
    "Finding",
    "IdcTab",
    "SipHeader",
    "describe",
    "describe_idctab",
    "describe_sip",
    "idctab_from_solution",
    "lint_idctab",
    "lint_sip",
    "read_idctab",
    "read_sip",
    "sip_from_solution",
    "sip_header",
    "worst_closure",
    "write_idctab",
    "write_sip",
]
