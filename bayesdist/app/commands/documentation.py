"""Pages of the documentation, which is part of the package and needs no network."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

import click

import bayesdist.version
from bayesdist.app.commands.options import command
from bayesdist.errors import InputError
from bayesdist.files.regular import read_text

_PACKAGE = Path(bayesdist.version.__file__).parent
_FOLDERS = (_PACKAGE / "docs", _PACKAGE.parent / "docs")  # installed, and in the source tree


@command()
@click.argument("page", required=False)
def docs(page: str | None) -> None:
    """Show a page of the documentation, or list all pages."""
    pages = _pages()
    if page is None:
        width = max(map(len, pages))
        for name, path in pages.items():
            click.echo(f"{name:{width}}  {_title(read_text(path))}")
        return
    name = page.removesuffix(".md")
    if name not in pages:
        near = get_close_matches(name, pages, n=1)
        raise InputError(
            f"the documentation has no page {page!r}",
            do=f"give {near[0]!r}" if near else "list all pages with 'bayesdist docs'",
        )
    click.echo_via_pager(read_text(pages[name]))


def _title(text: str) -> str:
    """First heading of a page, or the title in its front matter."""
    first = next(line for line in text.splitlines() if line.startswith(("# ", "title:")))
    return first.removeprefix("title:").strip("#' ")


def _pages() -> dict[str, Path]:
    """Files of the documentation pages by name."""
    for folder in _FOLDERS:
        pages = {path.stem: path for path in sorted(folder.glob("*.md"))}
        if pages:
            return pages
    raise InputError("the documentation is not installed", do="install the package again")
