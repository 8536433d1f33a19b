"""What every page of ours is made with: templates, and pictures that lie in the page itself."""

from __future__ import annotations

import base64
import struct
from dataclasses import dataclass

import jinja2
from markupsafe import Markup

from bayesdist.report.caption import Caption
from bayesdist.report.drawing import DPI
from bayesdist.report.numbers import number

__all__ = ["Picture", "picture_of", "template"]


@dataclass(frozen=True)
class Picture:
    """A picture as a page holds it.

    Parameters
    ----------
    name : str
    data : str
        The PNG file, base64.
    width : float
        Inches, at which its letters have the size they were set in.
    words : Caption
    """

    name: str
    data: str
    width: float
    words: Caption


def picture_of(name: str, png: bytes, words: Caption) -> Picture:
    """A PNG file, as of `drawn`, with its words."""
    (pixels,) = struct.unpack(">I", png[16:20])  # width, in the first chunk of every PNG file
    return Picture(name, base64.b64encode(png).decode("ascii"), pixels / DPI, words)


def template(name: str) -> jinja2.Template:
    """A template by its file name; what it needs and is not given is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("bayesdist.report"),
        autoescape=".html" in name,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_typeset,
    )
    environment.filters["md"] = _markdown
    environment.filters["css"] = _css
    environment.filters["number"] = lambda v: v if isinstance(v, str) else number(v)
    return environment.get_template(name)


# what Markdown would take for its own, in words of ours or of a user's file
_SPECIAL = str.maketrans(
    {"|": "\\|", "*": "\\*", "`": "\\`", "[": "\\[", "<": "&lt;", "&": "&amp;", "\n": " "}
)


def _typeset(value: object) -> object:
    """Sentences are written for terminals too, where +- stands for the sign."""
    return value.replace(" +- ", " ± ") if isinstance(value, str) else value


def _markdown(value: object) -> str:
    """Words as a line of Markdown that shows them as they are."""
    return str(value).translate(_SPECIAL)


def _css(value: object) -> Markup:
    """Words as a string of a style sheet: what is no plain letter by its number and a space."""
    plain = "".join(c if c.isalnum() or c in " .,:" else f"\\{ord(c):x} " for c in str(value))
    return Markup(f'"{plain}"')
