"""Calibration files that pipelines read, each with its uncertainty: written, read, and checked."""

from __future__ import annotations

from typing import Any

from bayesdist.lazy import lazy_name

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
    "bayesdist.products.maps_file": ("write_pam",),
    "bayesdist.products.registry": ("describe", "lint", "open_document", "read_calibration"),
    "bayesdist.products.release": ("Period", "Release", "write_release"),
}

__all__ = sorted(name for names in _HOMES.values() for name in names)


def __getattr__(name: str) -> Any:
    return lazy_name(__name__, _HOMES, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
