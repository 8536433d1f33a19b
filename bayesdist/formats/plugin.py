"""Entry point of the formats of calibration files."""

from bayesdist.plugin import Plugin

_PACKAGES = "ast cpdis idctab lookup siaf sip stdgdc tpv".split()
_MODULES = "gbdes jwst parameters roman wcs".split()

PLUGIN = Plugin(
    formats={
        **{name: f"bayesdist.formats.{name}.format:FORMAT" for name in _PACKAGES},
        **{name: f"bayesdist.formats.{name}:FORMAT" for name in _MODULES},
    }
)
