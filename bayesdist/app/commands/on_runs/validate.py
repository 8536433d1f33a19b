"""`bayesdist requirements`: margins of a run for requirements in a separate file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from bayesdist.app.assessment.error_terms import idle_dates
from bayesdist.app.assessment.evaluating import margins_of_run, validity_periods_of_run
from bayesdist.app.config import load_requirements
from bayesdist.app.run import Run
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.margins import margin_rows, margins_text, reasons_of
from bayesdist.app.tables.result_files import save_margins
from bayesdist.assess import Margin, Requirement
from bayesdist.errors import InputError

# by verdict, in order of precedence
EXIT_CODES = {"missed": 4, "undecided": 6, "not shown": 5}


def validate(run: str | Path, requirements: str | Path) -> tuple[str, int]:
    """Judge a run that has been sampled, and replace its margins and validity periods.

    Parameters
    ----------
    run : path
    requirements : path
        TOML file of ``[[requirement]]`` blocks.

    Returns
    -------
    str
        Text to print.
    int
        Exit code; see `exit_code`.
    """
    asked = load_requirements(requirements)
    directory = RunDirectory.open(run)
    with Run.of(directory) as opened:
        directory.require("requirements", ("fit", "sample"))
        asked = opened.config.within_field(asked)
        with _named_after(requirements, asked):
            margins = margins_of_run(opened, asked)
            periods = validity_periods_of_run(opened, asked)
        fit, posterior, gauge = opened.fit, opened.posterior, opened.gauge_words
        with directory.locked(), directory.judged_by(asked):
            save_margins(directory, fit, posterior, gauge, margins, periods)
        report = directory / "report.html"
        outdated = report.exists() and not directory.done("report")
    idle = idle_dates(opened.config, asked, str(requirements))
    lines = [*_lines(margins), *(period.sentence for period in periods)]
    lines += [f"WARNING: {idle}"] if idle else []
    if outdated:
        lines.append(f"{report} shows earlier margins; renew it by 'bayesdist stage report {run}'")
    return "\n".join(lines), exit_code(margins)


def exit_code(margins: Sequence[Margin]) -> int:
    """Exit code of the first verdict in `EXIT_CODES` that any margin has; 0 if there is none."""
    verdicts = {m.verdict for m in margins}
    return next((code for word, code in EXIT_CODES.items() if word in verdicts), 0)


@contextmanager
def _named_after(path: str | Path, asked: Sequence[Requirement]) -> Iterator[None]:
    """Prefix errors of requirements with the name of their file."""
    try:
        yield
    except InputError as error:
        if not error.where.startswith(tuple(r.where for r in asked)):
            raise
        raise type(error)(error.cause, where=f"{path}: {error.where}", do=error.do) from error


def _lines(margins: Sequence[Margin]) -> Iterator[str]:
    rows = margin_rows(margins)
    yield margins_text(rows)
    yield from reasons_of(rows)
