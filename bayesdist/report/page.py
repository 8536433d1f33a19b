"""Pages built from a registry and results: sections with tables and pictures, and templates."""

from __future__ import annotations

import base64
import functools
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import jinja2
from markupsafe import Markup

from bayesdist.report.contents import Registry, explanation_of, section_of
from bayesdist.report.drawing import Drawing
from bayesdist.report.figures.style import HALF_WIDTH
from bayesdist.report.texttable import Level, TextTable

REPORT = "bayesdist.report"  # package with the templates that all pages share
_AS_BROWSERS_SAY = {"svg": "svg+xml", "png": "png"}  # MIME subtypes
HALF, WIDE = HALF_WIDTH + 0.1, 5.3  # inches, including tolerance for trimmed or added margins


@dataclass(frozen=True)
class Picture:
    """A figure as embedded in a page."""

    name: str
    data: str  # file content in base64
    kind: str  # MIME subtype of the file
    width: float  # inches, at which text has its nominal size
    words: Drawing  # title, text and text alternative
    printed: bool = True  # True if it is shown on paper
    folded: bool = False  # True if it is shown only when a reader opens it
    number: int = 0  # figure number; 0 if figures are not numbered

    @property
    def place(self) -> str:
        """'half' if two fit side by side, 'wide' if there is no room for a caption next to it."""
        return "half" if self.width <= HALF else "wide" if self.width > WIDE else ""

    @property
    def hundredths(self) -> int:
        """Width in hundredths of an inch, as used in the style sheet."""
        return round(100 * self.width)


@dataclass(frozen=True)
class PagePart:
    """A section with its content."""

    name: str
    title: str
    tables: tuple[TextTable, ...]
    pictures: tuple[Picture, ...]
    parts: tuple[PagePart, ...] = ()  # subsections
    empty: str = ""  # text shown instead of tables; empty if there are tables
    printed: bool = True  # True if it is shown on paper
    on_top: tuple[Picture, ...] = ()  # its pictures that are shown at the top of the page


def numbered(
    top: Sequence[Picture], parts: Sequence[PagePart]
) -> tuple[tuple[Picture, ...], tuple[PagePart, ...]]:
    """Number the figures and tables of a page, pictures at the top first.

    The numbers are the same on screen and on paper, where some figures are left out.
    """
    figures, tables = count(1), count(1)
    top = tuple(replace(picture, number=next(figures)) for picture in top)
    by_name = {picture.name: picture for picture in top}

    def in_order(part: PagePart) -> PagePart:
        return replace(
            part,
            tables=tuple(replace(table, number=next(tables)) for table in part.tables),
            pictures=tuple(replace(p, number=next(figures)) for p in part.pictures),
            parts=tuple(in_order(inner) for inner in part.parts),
            on_top=tuple(by_name[p.name] for p in part.on_top),
        )

    return top, tuple(in_order(part) for part in parts)


def parts_of(
    registry: Registry, results: Any, drawings: Mapping[str, Drawing]
) -> tuple[PagePart, ...]:
    """Sections of a page that have content, or a text for missing content, in registry order.

    Figures that are not in `drawings` are left out.
    """
    tables: dict[str, list[TextTable]] = {}
    for item in registry.items(results, "table"):
        tables_of_item = _several(item.made(results))
        folded = (replace(table, folded=table.folded or table.is_long) for table in tables_of_item)
        tables.setdefault(item.section, []).extend(folded)
    pictures: dict[str, list[Picture]] = {}
    for item in registry.items(results, "figure"):
        if item.name in drawings:
            picture = picture_of(
                item.name, drawings[item.name], printed=item.printed, folded=item.folded
            )
            pictures.setdefault(item.section, []).append(picture)

    def within(parent: str) -> Sequence[PagePart]:
        out = []
        for section in registry.sections:
            if section.parent != parent:
                continue
            shown = tuple(sorted(tables.get(section.name, ()), key=lambda table: table.folded))
            part = PagePart(
                section.name,
                section.title_of(results),
                shown,
                tuple(sorted(pictures.get(section.name, ()), key=lambda picture: picture.folded)),
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


def picture_of(
    name: str, drawing: Drawing, *, printed: bool = True, folded: bool = False
) -> Picture:
    """Embed a drawing in a page."""
    data = base64.b64encode(drawing.file).decode("ascii")
    return Picture(
        name, data, _AS_BROWSERS_SAY[drawing.kind], drawing.width, drawing, printed, folded
    )


@functools.cache
def template(name: str, package: str = REPORT) -> jinja2.Template:
    """Template of a package by its file name; it may include templates of the report.

    Rendering raises an error if a variable of the template is missing.
    """
    packages = dict.fromkeys((package, REPORT))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader(package_name) for package_name in packages]
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_typeset,
    )
    environment.filters["css"] = _css
    # letters and digits, which cannot end an HTML attribute
    environment.filters["base64"] = lambda text: base64.b64encode(text.encode()).decode("ascii")
    environment.globals["explanation_of"] = explanation_of
    environment.globals["policy"] = _policy
    environment.globals["section_of"] = section_of
    environment.globals["widths_of"] = _widths
    environment.tests["level"] = lambda value: isinstance(value, Level)
    return environment.get_template(name)


# numbers as formatted for terminals: a power of ten, a minus sign at the start of a word
_POWER = re.compile(r"(?<![\w.])(-?\d+(?:\.\d+)?)e([+-])0*(\d+)\b")
_MINUS = re.compile(r"(?<![^\s(=±])-(?=\.?\d)")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _typeset(value: object) -> object:
    """Format a sentence written for terminals typographically; commands and data are unchanged."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    if " " not in value or value.startswith("bayesdist "):
        return value
    return _MINUS.sub("−", _POWER.sub(_raised, value.replace(" +- ", " ± ")))


def _raised(found: re.Match[str]) -> str:
    sign = "-" if found[2] == "-" else ""
    return f"{found[1]}\u202f×\u202f10{(sign + found[3]).translate(_RAISED)}"


def _policy(style: str, script: str) -> str:
    """Content security policy of a page: only its style sheet, its script and embedded images."""
    allowed = {"default": "'none'", "img": "data:", "style": _hash(style)}
    if script:
        allowed["script"] = _hash(script)
    fetched = "; ".join(f"{kind}-src {source}" for kind, source in allowed.items())
    return f"{fetched}; base-uri 'none'; form-action 'none'"


def _hash(text: str) -> str:
    """Hash of the text of an element, after typesetting, as used in the policy."""
    digest = hashlib.sha256(str(_typeset(text)).encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _widths(parts: Iterable[PagePart]) -> list[int]:
    """Widths of all pictures of some sections, without duplicates."""
    widths: set[int] = set()
    for part in parts:
        pictures = (*part.pictures, *part.on_top)
        widths.update((picture.hundredths for picture in pictures), _widths(part.parts))
    return sorted(widths)


def _css(value: object) -> Markup:
    """String for a style sheet, with special characters escaped by their code."""
    plain = "".join(c if c.isalnum() or c in " .,:" else f"\\{ord(c):x} " for c in str(value))
    return Markup(f'"{plain}"')
