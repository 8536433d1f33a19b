"""Entry point of the formats of calibration files."""

from bayesdist.plugin import Plugin

_PACKAGES = "idctab lookup siaf sip".split()
_MODULES = "ast cpdis gbdes jwst parameters roman stdgdc tpv wcs".split()

PLUGIN = Plugin(
    formats={
        **{name: f"bayesdist.formats.{name}.format:FORMAT" for name in _PACKAGES},
        **{name: f"bayesdist.formats.{name}:FORMAT" for name in _MODULES},
    }
)
