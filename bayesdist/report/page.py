"""Pages made of a registry and results: sections with their tables and pictures, templates."""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jinja2
from markupsafe import Markup

from bayesdist.numbers import MISSING
from bayesdist.report.drawing import DPI, Drawing
from bayesdist.report.registry import Registry
from bayesdist.report.texttable import Level, TextTable

__all__ = ["Part", "Picture", "parts_of", "picture_of", "template"]


@dataclass(frozen=True)
class Picture:
    """A figure as a page holds it.

    Parameters
    ----------
    name : str
    data : str
        The PNG file, base64.
    width : float
        Inches, at which its letters have the size they were set in.
    words : Drawing
        Title, text and what stands in place of the picture.
    printed : bool
        Whether it is on paper.
    """

    name: str
    data: str
    width: float
    words: Drawing
    printed: bool = True


@dataclass(frozen=True)
class Part:
    """A section with what it holds.

    Parameters
    ----------
    name, title : str
    tables : tuple of TextTable
    pictures : tuple of Picture
    parts : tuple of Part
        Sections within it.
    empty : str
        What stands in place of tables; empty where there are some.
    printed : bool
        Whether it is on paper.
    """

    name: str
    title: str
    tables: tuple[TextTable, ...]
    pictures: tuple[Picture, ...]
    parts: tuple[Part, ...] = ()
    empty: str = ""
    printed: bool = True


def parts_of(registry: Registry, results: Any, drawings: Mapping[str, Drawing]) -> tuple[Part, ...]:
    """The sections of a page that hold something, or say why they do not.

    Parameters
    ----------
    registry : Registry
    results
        What its functions are given.
    drawings : mapping of str to Drawing
        Of its figures, by name; figures that are not among them are left out.

    Returns
    -------
    tuple of Part
        In the order of the registry, those within others in these.
    """
    tables: dict[str, list[TextTable]] = {}
    for item in registry.items(results, "table"):
        tables.setdefault(item.section, []).extend(_several(item.made(results)))
    pictures: dict[str, list[Picture]] = {}
    for item in registry.items(results, "figure"):
        if item.name in drawings:
            picture = picture_of(item.name, drawings[item.name], printed=item.printed)
            pictures.setdefault(item.section, []).append(picture)

    def within(parent: str) -> Sequence[Part]:
        out = []
        for section in registry.sections:
            if section.parent != parent:
                continue
            shown = tuple(tables.get(section.name, ()))
            part = Part(
                section.name,
                section.title_of(results),
                shown,
                tuple(pictures.get(section.name, ())),
                tuple(within(section.name)),
                "" if shown else section.empty,
                section.is_printed(results),
            )
            if part.tables or part.pictures or part.parts or part.empty:
                out.append(part)
        return out

    return tuple(within(""))


def _several(made: TextTable | Iterable[TextTable] | None) -> Iterable[TextTable]:
    if made is None:
        return ()
    return (made,) if isinstance(made, TextTable) else made


def picture_of(name: str, drawing: Drawing, *, printed: bool = True) -> Picture:
    """A figure as it lies in a page."""
    (pixels,) = struct.unpack(">I", drawing.png[16:20])  # width, in the first chunk of a PNG file
    data = base64.b64encode(drawing.png).decode("ascii")
    return Picture(name, data, pixels / DPI, drawing, printed)


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
    environment.tests["level"] = lambda value: isinstance(value, Level)
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
    if isinstance(value, Level):
        return {"pass": "pass", "warn": "**warn**", "fail": "**FAIL**", "note": MISSING}[value]
    return str(value).translate(_SPECIAL)


def _css(value: object) -> Markup:
    """Words as a string of a style sheet: what is no plain letter by its number and a space."""
    plain = "".join(c if c.isalnum() or c in " .,:" else f"\\{ord(c):x} " for c in str(value))
    return Markup(f'"{plain}"')
