"""Runs a page of the documentation: its files, commands and Python, block by block as they stand.

Blocks of ``toml`` that begin with a comment ``# NAME`` become files; ``console`` lines after ``$``
are commands; ``python`` blocks share one namespace; ``text`` is what the block before it prints,
numbers aside, in pieces where ``...`` stands.  The cells of notebooks in MyST Markdown are run by
`run_notebook`.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from collections.abc import Container
from pathlib import Path

from bayesdist.app.cli import main

__all__ = ["DOCS", "blocks", "cells", "run_notebook", "run_page"]

DOCS = Path(__file__).resolve().parents[1] / "docs"
_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_CELL = re.compile(
    r"^```\{code-cell\} ipython3\n((?:^:[^\n]*\n)*)(.*?)^```$", re.MULTILINE | re.DOTALL
)
_EXIT = re.compile(r"\s+# exits with (\d)$")


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and text of the fenced blocks of a page."""
    return _FENCE.findall(page.read_text(encoding="utf-8"))


def cells(page: Path) -> list[str]:
    """Code of the cells of a notebook in MyST Markdown."""
    return [code for _, code in _CELL.findall(page.read_text(encoding="utf-8"))]


def run_notebook(page: Path) -> dict[str, object]:
    """Run the cells of a notebook in the current folder; their namespace.

    Lines that begin with ``!bayesdist`` are commands; `printed` of the namespace is a list of their
    outputs.
    """
    printed: list[str] = []
    namespace: dict[str, object] = {
        "printed": printed,
        "command": lambda line: printed.append(_command(line)),
    }
    for number, cell in enumerate(cells(page), start=1):
        cell = re.sub(r"^!(bayesdist .*)$", r"command('$ \1')", cell, flags=re.MULTILINE)
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile(cell, f"{page.name}, cell {number}", "exec"), namespace)
    return namespace


ALL = frozenset({"toml", "console", "python", "text"})


def run_page(page: Path, languages: Container[str] = ALL) -> dict[str, object]:
    """Run the blocks of these languages in the current folder; the namespace of the Python ones."""
    namespace: dict[str, object] = {}
    printed = ""
    for language, text in blocks(page):
        if language not in languages:
            continue
        if language == "toml":
            name = re.match(r"# (\S+\.toml)\n", text)
            assert name, f"{page.name}: a block of toml without a file name in its first line"
            Path(name.group(1)).write_text(text, encoding="utf-8")
        elif language == "console":
            printed = "".join(_command(line) for line in text.splitlines())
        elif language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(text, page.name, "exec"), namespace)
            printed = out.getvalue()
        elif language == "text":
            for piece in re.split(r"^\.\.\.$", text, flags=re.MULTILINE):
                assert _shape(piece) in _shape(printed), f"{page.name}: is not printed:\n{piece}"
    return namespace


def _command(line: str) -> str:
    assert line.startswith("$ bayesdist "), f"not a command of bayesdist: {line}"
    code = int(found.group(1)) if (found := _EXIT.search(line)) else 0
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(shlex.split(_EXIT.sub("", line))[2:]) == code, line
    return out.getvalue()


def _shape(text: str) -> str:
    """A text with its numbers, rules and widths made equal."""
    text = re.sub(r"-{2,}", "--", " ".join(text.split()))
    return re.sub(r"(?<![\w.])[-+]?\d[\d.]*(e[-+]?\d+)?", "#", text)
