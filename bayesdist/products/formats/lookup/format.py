"""Format entry of D2IMFILE and NPOLFILE."""

from __future__ import annotations

from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import Format
from bayesdist.products.formats.lookup.file import AXES, LookupFile
from bayesdist.products.formats.lookup.lint import lint_lookup_file
from bayesdist.products.formats.lookup.text import describe_lookup_file

__all__ = ["FORMAT"]


def _parse(content: Content) -> LookupFile | None:
    hdus = content.tables
    if not any(hdu.name in AXES for hdu in hdus[1:]):
        return None
    return LookupFile(hdus, content.name)


FORMAT = Format(
    "lookup", "a D2IMFILE or NPOLFILE", 3, _parse, describe_lookup_file, lint_lookup_file
)
