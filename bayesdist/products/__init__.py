"""Calibration files that pipelines read, each with its uncertainty: written, read, and checked."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_FORMATS = "bayesdist.products.formats"
_HOMES = {
    f"{_FORMATS}.common.document": ("Choice", "Document", "Finding", "Format"),
    f"{_FORMATS}.idctab.build": ("idctab_from_solution",),
    f"{_FORMATS}.idctab.lint": ("lint_idctab",),
    f"{_FORMATS}.idctab.table": ("IdcTab", "read_idctab", "write_idctab"),
    f"{_FORMATS}.lookup.d2im": ("read_d2im", "write_d2im"),
    f"{_FORMATS}.lookup.file": ("LookupFile", "read_lookup_file", "write_lookup_file"),
    f"{_FORMATS}.lookup.lint": ("lint_lookup_file",),
    f"{_FORMATS}.lookup.npol": ("read_npol", "write_npol"),
    f"{_FORMATS}.sip.build": ("sip_from_solution",),
    f"{_FORMATS}.sip.header": ("SipHeader", "worst_closure"),
    f"{_FORMATS}.sip.implied": ("Implied", "implied_values"),
    f"{_FORMATS}.sip.lint": ("lint_sip",),
    f"{_FORMATS}.sip.read": ("read_sip",),
    f"{_FORMATS}.sip.rotate": ("rotated_sip",),
    f"{_FORMATS}.sip.write": ("sip_header", "write_sip"),
    f"{_FORMATS}.wise.build": ("write_wise_meta",),
    f"{_FORMATS}.wise.lint": ("lint_wise_band",),
    f"{_FORMATS}.wise.meta": ("WiseBand", "read_wise_meta"),
    "bayesdist.products.pam_file": ("write_pam",),
    "bayesdist.products.registry": ("describe", "lint", "open_document", "read_calibration"),
    "bayesdist.products.release": ("Period", "Release", "write_release"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        return getattr(import_module(_HOME_OF[name]), name)
    raise AttributeError(f"module 'bayesdist.products' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
