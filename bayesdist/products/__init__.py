"""Calibration files that pipelines read, each with its uncertainty: written, read, and checked."""

from bayesdist.products.d2im import read_d2im, write_d2im
from bayesdist.products.idctab import IdcTab, read_idctab, write_idctab
from bayesdist.products.idctab_build import idctab_from_solution
from bayesdist.products.idctab_lint import lint_idctab
from bayesdist.products.inspect import (
    describe,
    describe_idctab,
    describe_lookup_file,
    describe_sip,
)
from bayesdist.products.lint import Finding
from bayesdist.products.lookup_file import LookupFile, read_lookup_file, write_lookup_file
from bayesdist.products.lookup_lint import lint_lookup_file
from bayesdist.products.npol import read_npol, write_npol
from bayesdist.products.sip import SipHeader
from bayesdist.products.sip_build import sip_from_solution
from bayesdist.products.sip_inverse import worst_closure
from bayesdist.products.sip_lint import lint_sip
from bayesdist.products.sip_read import read_sip
from bayesdist.products.sip_write import sip_header, write_sip

__all__ = [
    "Finding",
    "IdcTab",
    "LookupFile",
    "SipHeader",
    "describe",
    "describe_idctab",
    "describe_lookup_file",
    "describe_sip",
    "idctab_from_solution",
    "lint_idctab",
    "lint_lookup_file",
    "lint_sip",
    "read_d2im",
    "read_idctab",
    "read_lookup_file",
    "read_npol",
    "read_sip",
    "sip_from_solution",
    "sip_header",
    "worst_closure",
    "write_d2im",
    "write_idctab",
    "write_lookup_file",
    "write_npol",
    "write_sip",
]
