"""The core knows no file format of a single observatory and no mission: it names none."""

from __future__ import annotations

import re

from tests.app.support import REPOSITORY

SHELVES = ("formats", "kinds", "missions", "app/kinds")  # folders of bayesdist
WORDS = re.compile(r"\b(IDCTAB|VAFACTOR|hst1pass|WISE|ACS)\b")


def test_no_file_of_the_core_names_a_mission_or_its_files():
    package = REPOSITORY / "bayesdist"
    shelves = [package / name for name in SHELVES]
    found = [
        f"{path.relative_to(package)}:{number}: {line.strip()}"
        for suffix in ("py", "pyi", "jinja", "css", "js")
        for path in sorted(package.rglob(f"*.{suffix}"))
        if not any(path.is_relative_to(shelf) for shelf in shelves)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if WORDS.search(line)
    ]
    assert not found, "\n".join(found)
