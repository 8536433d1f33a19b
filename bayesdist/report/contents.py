"""Contents of a page: a registry of figures and tables, and the sections of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, Literal, TypeVar

from matplotlib.figure import Figure

from bayesdist.report.figures.style import figure_style

T = TypeVar("T")
Make = TypeVar("Make", bound=Callable[..., Any])
Kind = Literal["figure", "table", "data"]
When = Callable[[Any], bool]


_ANY = ("report", "Figures")  # documentation of sections that name no other page


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure with its texts."""

    figure: Figure
    title: str
    text: str  # explanation
    alt: str  # text alternative to the picture


@dataclass(frozen=True)
class PageSection:
    """Section of a page; `title` and `printed` (shown on paper) may be functions of the results."""

    name: str
    title: str | Callable[[Any], str]
    empty: str = ""  # text shown instead of missing tables; without it the section is left out
    parent: str = ""  # name of the section that contains this one
    printed: bool | When = True
    when: When | None = None  # condition on the results for all entries of the section
    explained: tuple[str, str] = _ANY  # page of the documentation that explains it, and its heading
    groups: tuple[str, ...] = ()  # groups of the status table whose details are in the section

    def title_of(self, results: Any) -> str:
        """Title for a page with these results."""
        return self.title if isinstance(self.title, str) else self.title(results)

    def is_printed(self, results: Any) -> bool:
        """True if the section is shown on paper."""
        return self.printed(results) if callable(self.printed) else self.printed


@dataclass(frozen=True)
class Entry:
    """Figure, table or data of a page; `each` returns names and arguments of several figures."""

    name: str  # of the function, and of the files of a figure
    section: str  # empty for data
    kind: Kind
    make: Callable[..., Any]  # function of the results and an item of `each`
    needs: tuple[str, ...] = ()  # attributes of the results that must be neither None nor empty
    when: When | None = None  # further condition on the results
    each: Callable[[Any], Mapping[str, Any]] | None = None
    printed: bool | When = False  # shown on paper
    folded: bool = False  # on screen, shown only when a reader opens it

    def applies(self, results: Any) -> bool:
        """True if it can be made from these results."""
        if not all(_present(results, path) for path in self.needs):
            return False
        return self.when is None or self.when(results)


@dataclass(frozen=True)
class Item:
    """An entry for a page with given results; its function takes the results and `arguments`."""

    name: str
    section: str
    make: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    printed: bool = False
    folded: bool = False

    def made(self, results: Any) -> Any:
        """Figure, table or data made from the results."""
        return self.make(results, *self.arguments)


class Registry:
    """Figures, tables and data of one kind of page, in sections that are in the page's order."""

    def __init__(self, name: str, sections: Sequence[PageSection]) -> None:
        self.name, self.sections = name, tuple(sections)
        self._entries: list[Entry] = []
        self._inserted: set[str] = set()  # names of sections that plugins have added

    def figure(
        self,
        section: str,
        *,
        needs: tuple[str, ...] = (),
        when: When | None = None,
        each: Callable[[Any], Mapping[str, Any]] | None = None,
        printed: bool | When = False,
        folded: bool = False,
    ) -> Callable[[Make], Make]:
        """Decorator for a function that makes a `Plot`; for the parameters see `Entry`."""
        options = {"needs": needs, "when": when, "each": each, "printed": printed}
        options["folded"] = folded
        return self._decorator(section, "figure", options)

    def table(
        self, section: str, *, needs: tuple[str, ...] = (), when: When | None = None
    ) -> Callable[[Make], Make]:
        """Decorator for a function that makes one or several `TextTable`, or None."""
        return self._decorator(section, "table", {"needs": needs, "when": when})

    def data(self, *, needs: tuple[str, ...] = ()) -> Callable[[Make], Make]:
        """Decorator for a function that makes data for the scripts of the page."""
        return self._decorator("", "data", {"needs": needs})

    def _decorator(
        self, section: str, kind: Kind, options: Mapping[str, Any]
    ) -> Callable[[Make], Make]:
        def register(make: Make) -> Make:
            name = make.__name__
            if any(entry.name == name and entry.kind == kind for entry in self._entries):
                raise ValueError(f"{self.name}: two entries are called {name}")
            styled = figure_style()(make) if kind == "figure" else make
            self._entries.append(Entry(name, section, kind, styled, **options))
            return styled

        return register

    def insert(self, after: str, *sections: PageSection) -> None:
        """Add sections after the one with the given name.

        Those of several plugins follow each other by name, whichever is imported first.
        """
        names = [section.name for section in self.sections]
        place = names.index(after) + 1
        while names[place] in self._inserted and names[place] < sections[0].name:
            place += 1
        self.sections = (*self.sections[:place], *sections, *self.sections[place:])
        self._inserted |= {section.name for section in sections}

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Entries in the order of the sections, then of registration."""
        order = ["", *(section.name for section in self.sections)]
        return tuple(sorted(self._entries, key=lambda entry: order.index(entry.section)))

    def items(self, results: Any, kind: Kind) -> tuple[Item, ...]:
        """Items that can be made from these results, in the order of the page."""
        out = []
        absent = {s.name for s in self.sections if s.when is not None and not s.when(results)}
        for entry in self.entries:
            if entry.kind != kind or entry.section in absent or not entry.applies(results):
                continue
            printed = entry.printed(results) if callable(entry.printed) else entry.printed
            if entry.each is None:
                items: Mapping[str, tuple[Any, ...]] = {entry.name: ()}
            else:
                items = {name: (argument,) for name, argument in entry.each(results).items()}
            out += [
                Item(name, entry.section, entry.make, arguments, printed, entry.folded)
                for name, arguments in items.items()
            ]
        return tuple(out)


def _present(results: Any, path: str) -> bool:
    """True if a (nested) attribute is neither None nor empty."""
    value = reduce(
        lambda of, name: None if of is None else getattr(of, name), path.split("."), results
    )
    return value is not None and (not isinstance(value, tuple | Mapping) or bool(value))


def needed(value: T | None) -> T:
    """Value that is not None because the registry has checked `needs` of the entry."""
    if value is None:
        raise LookupError("a figure is drawn without its required input")
    return value


REPORT = Registry(
    "report",
    (
        PageSection("status", "Status", explained=("report", "Summary")),
        PageSection(
            "holdout",
            "Held-out stars",
            explained=("method", "Held-out stars"),
            groups=("Held-out truth",),
        ),
        PageSection(
            "data",
            "Data",
            printed=lambda run: run.kind.words.prints_data,
            explained=("your_table", ""),
            groups=("Matching",),
        ),
        PageSection(
            "fit",
            lambda run: run.kind.words.fit_title,
            explained=("method", "Linear fit"),
            groups=("Score tests", "Fit"),
        ),
        PageSection("residuals", "Residuals", explained=("method", "Tests for what a model lacks")),
        PageSection(
            "outliers",
            "Outliers",
            printed=False,
            explained=("concepts", "Jitter and membership"),
            groups=("Sampling",),
        ),
        PageSection("coefficients", "Coefficients", explained=("method", "Model")),
        PageSection(
            "maps",
            "Distortion and its uncertainty over the detector",
            explained=("concepts", "What 68 % means"),
        ),
        PageSection(
            "previous",
            "Difference from the previous release",
            explained=("report", "Difference from the previous release"),
        ),
        PageSection("periods", "Time variation", explained=("wise", ""), groups=("Periods",)),
        PageSection(
            "budget",
            "Error budget",
            explained=("method", "Error budget and margins"),
            groups=("Errors", "Assumptions"),
        ),
        PageSection(
            "margins",
            "Margins",
            empty="No requirement was stated.",
            explained=("method", "What a verdict rests on"),
            groups=("Requirements", "Validity"),
        ),
        PageSection(
            "products",
            "Products",
            empty="No product was written.",
            explained=("files", ""),
            groups=("Products",),
        ),
        PageSection("provenance", "Provenance", explained=("files", "")),
    ),
)


def explanation_of(section: str) -> str:
    """Command that shows the documentation of a section, and the heading to look for."""
    of_section = {known.name: known.explained for known in REPORT.sections}
    page, heading = of_section.get(section, _ANY)
    return f"bayesdist docs {page}" + (f", “{heading}”" if heading else "")


def section_of(group: str) -> str:
    """Section of the report for a group of the status table; the group itself if there is none."""
    names = {of: section.name for section in REPORT.sections for of in section.groups}
    return names.get(group, group)
