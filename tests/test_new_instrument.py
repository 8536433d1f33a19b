"""docs/new_instrument.md, followed to the letter: a package from outside adds an instrument."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from lxml import html

from .app.several import encoded, results_of
from .docs_blocks import DOCS, blocks

PAGE = DOCS / "new_instrument.md"
FILE = "megacam_gaia/megacam744331p_gaiadr1_pairs_8arcsec.csv"
POSITIONS = [f"{z}_{which}_arcsec" for which in ("hdrwcs", "gaia") for z in "xy"]
MIDDLE = ((-640.4, 148.0), (-950.0, -40.0))  # arcsec: two CCDs side by side
FEW_DRAWS = "[sampler]\nmax_steps = 20\n"


def named_blocks() -> dict[str, str]:
    """Blocks of the page that are files, or changes of files, by the names in their first lines."""
    found = {}
    for language, text in blocks(PAGE):
        if language in ("python", "toml"):
            name = re.match(r"# (\S+)\n", text)
            assert name, text
            found[name.group(1)] = text
    return found


def installed(folder: Path, texts: dict[str, str]) -> None:
    """The package as an installer leaves it: its modules, and what its pyproject.toml says."""
    for name in ("megacam.py", "megacam_report.py"):
        (folder / name).write_text(texts[name], encoding="utf-8")
    project = tomllib.loads(texts["pyproject.toml"])["project"]
    info = folder / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    lines = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {target}" for name, target in entries.items())]
    (info / "entry_points.txt").write_text("\n".join(lines))


def changed(text: str, changes: str) -> str:
    """A configuration with keys set in its sections, and blocks of lists at its end."""
    for block in re.split(r"\n(?=\[)", changes.partition("\n")[2].strip()):
        header, *lines = block.splitlines()
        if header.startswith("[["):
            text += f"\n{block}\n"
            continue
        before, found, after = text.partition(f"\n{header}\n")
        assert found, f"{header} is not in the configuration"
        section, bracket, rest = after.partition("\n[")
        for line in filter(None, lines):
            key = line.split(" = ")[0]
            section, n = re.subn(rf"^(# )?{key} = .*$", line, section, count=1, flags=re.M)
            section = section if n else f"{line}\n{section}"
        text = before + found + section + bracket + rest
    return text


@pytest.fixture(scope="module")
def pairs(data_dir, full) -> Table:
    """Pairs of the middle of the mosaic, or all of them."""
    table = Table.read(data_dir / FILE)
    if full:
        return table
    inside = [
        (table[f"{name}_hdrwcs_arcsec"] >= low) & (table[f"{name}_hdrwcs_arcsec"] < high)
        for name, (low, high) in zip("xy", MIDDLE, strict=True)
    ]
    return table[inside[0] & inside[1]]


@pytest.fixture(scope="module")
def followed(tmp_path_factory, pairs, full):
    """Folder in which the page was followed, and what each command printed.

    Reduced, draws are few, and figures of the report are not drawn.
    """
    folder = tmp_path_factory.mktemp("megacam")
    pairs.write(folder / "pairs.csv", format="ascii.csv")
    texts = named_blocks()
    installed(folder, texts)
    path = os.pathsep.join([str(folder), str(DOCS.parent)])
    printed = {}
    for language, text in blocks(PAGE):
        if language == "toml" and text.startswith("# megacam.toml\n"):
            config = folder / "megacam.toml"
            changes = text if full else f"{text}\n{FEW_DRAWS}"
            config.write_text(changed(config.read_text("utf-8"), changes), encoding="utf-8")
        if language == "console":
            commands = [shlex.split(line) for line in text.splitlines()]
            assert all(words[:2] == ["$", "bayesdist"] for words in commands)
            done = subprocess.run(
                [sys.executable, "-m", "tests.app.several", *encoded(w[2:] for w in commands)],
                cwd=folder, env={**os.environ, "PYTHONPATH": path},
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            for words, result in zip(commands, results_of(done), strict=True):
                assert result.code == 0, result.err
                printed[words[2]] = result.out
    return folder, printed


def test_the_format_is_recognised(followed, pairs, full):
    folder, printed = followed
    once = len({tuple(row) for row in pairs.as_array()[POSITIONS].tolist()})
    assert f"for {once} matches" in printed["init"]
    config = tomllib.loads((folder / "megacam.toml").read_text("utf-8"))
    ccds = range(36) if full else (12, 13)
    assert [one["name"] for one in config["chip"]] == [f"ccd{k:02d}" for k in ccds]
    n = 12 * len(ccds)
    assert f"{n} of {n}, nothing is degenerate" in printed["check"]


def test_the_term_is_a_row_of_the_budget(followed, pairs):
    """A stretch by 2e-5 of the distance from the tangent point, along v alone."""
    folder, _ = followed
    budget = Table.read(folder / "megacam-run" / "budget.ecsv")
    row = next(one for one in budget if one["name"] == "refraction that is left over")
    distance = np.sqrt(np.mean(np.square(pairs["y_gaia_arcsec"])))
    assert row["u"] == 0 and row["v"] == pytest.approx(2e-5 * distance, rel=0.1)


def test_the_table_is_in_the_report(followed):
    folder, _ = followed
    page = html.fromstring((folder / "megacam-run" / "report.html").read_bytes())
    assert "Residuals of the least-squares fit, CCD by CCD" in page.text_content()
    rows = [[cell.text_content().strip() for cell in row] for row in page.xpath("//tr")]
    numbers = [row[1:3] for row in rows if re.fullmatch(r"ccd\d\d", row[0])]
    used = sum(int(n) for total, n in numbers if total.isdigit() and n.isdigit())
    summary = json.loads((folder / "megacam-run" / "summary.json").read_text("utf-8"))
    assert used == summary["data"]["n_used"]
