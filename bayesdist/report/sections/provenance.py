"""Written files, and the provenance of the result."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.report.contents import REPORT
from bayesdist.report.run import ReportedRun
from bayesdist.report.texttable import Level, TextTable, check_cells, listing, moment, short_paths
from bayesdist.utils.checks import Check
from bayesdist.utils.text import MISSING, count, number, percent

_BLANK = "_" * 24  # to be filled in on paper
_DETAILS = ("stages", "timings", "versions")  # not printed; each page names the version
_PRINTED = {"inputs": 4}  # number of rows on paper


def written_files(run: ReportedRun) -> tuple[Mapping[str, Any], ...]:
    """Files that the run wrote, as in summary.json: 'path', 'kind', 'findings' and others."""
    return tuple(run.summary.get("products", ()))


def checks_of_file(written: Mapping[str, Any]) -> tuple[Check, ...]:
    """Checks of a product after it was written."""
    named = {
        "closure_pix": "worst closure of the inverse (pix)",
        "a_dmax": "A_DMAX (pix)",
        "b_dmax": "B_DMAX (pix)",
    }
    values = {name: written.get(key) for key, name in named.items()}
    if sky := written.get("sky"):
        values[f"rms distance from RA, Dec of {sky['n']} stars (arcsec)"] = sky["rms_arcsec"]
        values["largest distance from the solution (arcsec)"] = sky["solution_arcsec"]
    out = [Check("Products", name, size) for name, size in values.items() if size is not None]
    levels = {"error": "fail", "warning": "warn", "note": "note"}
    for finding in written["findings"]:
        level, _, text = finding.partition(": ")
        # the finding is the sentence, and the headline names the criterion
        name = "reading by other programs"
        out.append(Check("Products", name, text, "", levels.get(level, "note")))
    return tuple(out)


@REPORT.table("products", when=lambda run: bool(written_files(run)))
def product_table(run: ReportedRun) -> TextTable:
    """Table of files with their checks; an outcome that several files share is one row."""
    files_by_outcome: dict[tuple[str, ...], list[str]] = {}  # by the outcome of a check
    written = {str(row["path"]): row for row in written_files(run)}
    for path, row in written.items():
        for check in checks_of_file(row):
            files_by_outcome.setdefault((check.name, *check_cells(check)), []).append(path)
    rows: list[tuple[str, ...]] = []
    for path, row in written.items():
        own_rows = [cells for cells, files in files_by_outcome.items() if files == [path]]
        head = path, str(row["kind"])
        for cells in own_rows or [(MISSING, MISSING, MISSING, Level("note"))]:
            rows.append((*head, *cells))
            head = "", ""
    for cells, files in files_by_outcome.items():
        if len(files) > 1:
            rows.append((", ".join(files), MISSING, *cells))
    heads = ("File", "Format", "Check", "Found", "Limit", "Status")
    return TextTable("Files written", heads, tuple(rows), words=tuple(range(6)), stacked=(3, 4))


@REPORT.table("provenance")
def document_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables that identify and release a copy: document id, hash, signatures."""
    digest = config_hash(run)
    document = {"Document id": document_id(run), "SHA-256 of the resolved configuration": digest}
    rows = tuple((role, _BLANK, _BLANK, _BLANK) for role in ("Prepared", "Reviewed", "Approved"))
    heads = ("Role", "Name", "Date", "Signature")
    return (
        listing("Document", document),
        TextTable("Sign-off", heads, rows, words=tuple(range(len(heads))), folded=True),
    )


def config_hash(run: ReportedRun) -> str:
    """SHA-256 of the resolved configuration, independent of the order of its keys."""
    text = json.dumps(run.configuration, sort_keys=True, default=str)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def document_id(run: ReportedRun) -> str:
    """Name of the calibration, day of the run, and eight digits from configuration and start.

    Every run has a different id, and all reports of a run have the same one.
    """
    began = str(run.provenance.get("created", ""))
    digest = hashlib.sha256(f"{config_hash(run)} {began}".encode()).hexdigest()[:8]
    name = re.sub(r"[^A-Za-z0-9]+", "-", run.title).strip("-") or "calibration"
    return "-".join(part for part in (name, began[:10].replace("-", ""), digest) if part)


@REPORT.table("provenance")
def provenance_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables of the provenance: single values, followed by a table for each group."""
    single = {k: _plain(v) for k, v in run.provenance.items() if not isinstance(v, Mapping)}
    s = run.posterior.sampler
    single["sampler"] = (
        f"{s.method}; {s.ensembles} ensembles of {s.walkers} walkers, {count(s.steps)} steps,"
        f" {count(s.passes)} passes over the data, acceptance {percent(s.acceptance, 2)},"
        f" {number(s.wall_s)} s, seed {s.seed}"
    )
    if "created" in single:
        single["created"] = moment(single["created"])
    if "command" in single:
        single["command"] = _without_folders(single["command"])
    named = {k[:1].upper() + k[1:]: v for k, v in single.items()}
    out = [listing("Run", named)] if named else []
    for key, value in run.provenance.items():
        if isinstance(value, Mapping):
            unit = " [s]" if key == "timings" else ""
            shown = _stage if key == "stages" else _plain
            names = short_paths(value) if key == "inputs" else map(str, value)
            table = listing(
                f"{key.capitalize()}{unit}",
                dict(zip(names, map(shown, value.values()), strict=True)),
                detail=key in _DETAILS,
                leading=_PRINTED.get(key, 0),
            )
            out.append(replace(table, folded=key in _DETAILS))
    return tuple(out)


def _without_folders(command: str) -> str:
    """Command line without the folders of absolute paths, which run.json has."""
    try:
        words = shlex.split(command)
    except ValueError:  # it was changed since it was recorded
        return command
    return shlex.join(Path(word).name if Path(word).is_absolute() else word for word in words)


def _stage(note: Mapping[str, Any]) -> str:
    return f"{number(note['wall_s'])} s, ended {moment(note['ended'])}"


def _plain(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: MISSING}[value]
    if isinstance(value, float | np.floating):
        return f"{value:.6g}" if np.isfinite(value) else MISSING
    if isinstance(value, list | tuple):
        return ", ".join(_plain(v) for v in value) or MISSING
    if isinstance(value, Mapping):
        return ", ".join(f"{k} = {_plain(v)}" for k, v in value.items()) or MISSING
    return str(value) or MISSING


@REPORT.table("provenance")
def config_table(run: ReportedRun) -> TextTable | None:
    """Table of the resolved configuration, with one row per key."""
    pairs: dict[str, str] = {}
    for section, value in run.configuration.items():
        if isinstance(value, Mapping):
            pairs.update({f"{section}.{key}": _plain(v) for key, v in value.items()})
        elif isinstance(value, list | tuple):  # blocks: [[budget]], [[requirement]], [[chip]]
            pairs.update({f"{section} {k}": _plain(v) for k, v in enumerate(value, start=1)})
        else:
            pairs[str(section)] = _plain(value)
    if not pairs:
        return None
    return replace(listing("Resolved configuration", pairs, detail=True), folded=True)
