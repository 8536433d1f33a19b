"""What a page shows: each figure, table and data set with its words and when it applies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, Literal, TypeVar

from matplotlib.figure import Figure

__all__ = ["Entry", "Item", "Plot", "Registry", "Section"]

Make = TypeVar("Make", bound=Callable[..., Any])
Kind = Literal["figure", "table", "data"]
When = Callable[[Any], bool]


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure and its words.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    title : str
    text : str
        What to see.
    alt : str
        What the picture shows, for those who cannot see it.
    """

    figure: Figure
    title: str
    text: str
    alt: str


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Parameters
    ----------
    name : str
    title : str or callable
        A callable is given the results.
    empty : str
        What stands in place of the section's tables where there are none; a section without it is
        left out where nothing in it applies.
    parent : str
        Section that it is a part of.
    printed : bool or callable
        Whether it is on paper.
    """

    name: str
    title: str | Callable[[Any], str]
    empty: str = ""
    parent: str = ""
    printed: bool | When = True

    def title_of(self, results: Any) -> str:
        """The title in the page of some results."""
        return self.title if isinstance(self.title, str) else self.title(results)

    def is_printed(self, results: Any) -> bool:
        """Whether the section is on paper."""
        return self.printed(results) if callable(self.printed) else self.printed


@dataclass(frozen=True)
class Entry:
    """A figure, a table or data of a page.

    Parameters
    ----------
    name : str
        Of the function that makes it; of a figure, the name of its files, too.
    section : str
        Data belong to none.
    kind : {'figure', 'table', 'data'}
    make : callable
        Given the results, and what `each` says; a figure is a `Plot`, a table a `TextTable`, a
        sequence of them, or None, data are what JSON can hold.
    needs : tuple of str
        Attributes of the results that must be there: neither None nor empty.
    when : callable, optional
        Condition that no attribute states.
    each : callable, optional
        Of the results: name and argument of every figure that the function makes.
    printed : bool, callable or 'first'
        Whether the figure is on paper, or the first of several.
    """

    name: str
    section: str
    kind: Kind
    make: Callable[..., Any]
    needs: tuple[str, ...] = ()
    when: When | None = None
    each: Callable[[Any], Mapping[str, Any]] | None = None
    printed: bool | When | Literal["first"] = False

    def applies(self, results: Any) -> bool:
        """Whether it can be made of these results."""
        if not all(_present(results, path) for path in self.needs):
            return False
        return self.when is None or self.when(results)


@dataclass(frozen=True)
class Item:
    """An entry as it stands in the page of some results.

    Parameters
    ----------
    name : str
    section : str
    make : callable
    arguments : tuple
        What the function is given beside the results.
    printed : bool
    """

    name: str
    section: str
    make: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    printed: bool = False

    def made(self, results: Any) -> Any:
        """The figure, table or data."""
        return self.make(results, *self.arguments)


class Registry:
    """Everything that one kind of page can show.

    Parameters
    ----------
    name : str
    sections : sequence of Section
        In the order of the page.
    """

    def __init__(self, name: str, sections: Sequence[Section]) -> None:
        self.name, self.sections = name, tuple(sections)
        self._entries: list[Entry] = []

    def figure(
        self,
        section: str,
        *,
        needs: tuple[str, ...] = (),
        when: When | None = None,
        each: Callable[[Any], Mapping[str, Any]] | None = None,
        printed: bool | When | Literal["first"] = False,
    ) -> Callable[[Make], Make]:
        """Decorator of a function that makes a `Plot`; parameters as of `Entry`."""
        options = {"needs": needs, "when": when, "each": each, "printed": printed}
        return self._decorator(section, "figure", options)

    def table(
        self, section: str, *, needs: tuple[str, ...] = (), when: When | None = None
    ) -> Callable[[Make], Make]:
        """Decorator of a function that makes a `TextTable`, several, or None."""
        return self._decorator(section, "table", {"needs": needs, "when": when})

    def data(self, *, needs: tuple[str, ...] = ()) -> Callable[[Make], Make]:
        """Decorator of a function that makes data for the scripts of the page."""
        return self._decorator("", "data", {"needs": needs})

    def _decorator(
        self, section: str, kind: Kind, options: Mapping[str, Any]
    ) -> Callable[[Make], Make]:
        def register(make: Make) -> Make:
            name = make.__name__
            if any(entry.name == name and entry.kind == kind for entry in self._entries):
                raise ValueError(f"{self.name}: two entries are called {name}")
            self._entries.append(Entry(name, section, kind, make, **options))
            return make

        return register

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All entries, in the order of sections, then of registration."""
        order = ["", *(section.name for section in self.sections)]
        return tuple(sorted(self._entries, key=lambda entry: order.index(entry.section)))

    def items(self, results: Any, kind: Kind) -> tuple[Item, ...]:
        """What can be made of some results, in the order of the page.

        Parameters
        ----------
        results
            What the functions are given.
        kind : {'figure', 'table', 'data'}

        Returns
        -------
        tuple of Item
        """
        out = []
        for entry in self.entries:
            if entry.kind != kind or not entry.applies(results):
                continue
            printed = entry.printed(results) if callable(entry.printed) else bool(entry.printed)
            if entry.each is None:
                out.append(Item(entry.name, entry.section, entry.make, printed=printed))
                continue
            for name, argument in entry.each(results).items():
                out.append(Item(name, entry.section, entry.make, (argument,), printed))
                printed = printed and entry.printed != "first"
        return tuple(out)


def _present(results: Any, path: str) -> bool:
    """Whether an attribute, or one of an attribute, is there."""
    value = reduce(
        lambda of, name: None if of is None else getattr(of, name), path.split("."), results
    )
    return value is not None and (not isinstance(value, tuple | Mapping) or bool(value))
