"""The headline is the worst row, names the epoch that it is of, and until when it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.assess.requirements.margins import ValidityPeriod
from bayesdist.assess.requirements.verdict import catalogue_checks
from bayesdist.report.contents import section_of
from bayesdist.report.sections import REPORT
from bayesdist.report.sections.provenance import product_table
from bayesdist.report.sections.status import status_checks, status_table, verdict
from bayesdist.utils.checks import GROUPS, LARGER, Check

from .runs import written

YEARS = np.linspace(2010.3, 2020.3, 41)


def _met_only(run):
    return run.having(margins=tuple(m for m in run.evaluation.margins if m.verdict == "met"))


def _period(run, end: float) -> ValidityPeriod:
    """Probability that falls from 1 to 0, and passes what is asked at `end`."""
    asked = run.evaluation.margins[0].requirement
    p = np.clip(asked.probability + 0.3 * (end - YEARS), 0.0, 1.0)
    return ValidityPeriod(asked, YEARS, p, p - 0.01, p + 0.01, np.ones_like(p))


def test_a_row_that_warns_is_in_the_headline(converged):
    good = _met_only(converged)
    assert verdict(good).level == "pass"
    row = Check("Fit", "Odd stars", "three", "none", "warn")
    worse = verdict(good.having(checks=(*good.evaluation.checks, row)))
    assert worse.level == "warn" and worse.headline.startswith("One criterion warns (Odd stars)")
    failed = verdict(good.having(checks=(*good.evaluation.checks, row, replace(row, level="fail"))))
    assert failed.level == "fail" and failed.headline.startswith("One criterion fails (Odd stars)")


def test_several_findings_of_a_file_are_counted_and_the_file_named_once(converged):
    file = written("a.hdr", "SIP", "warning: no parity", "warning: no CRVAL")
    run = _met_only(converged).having(summary={"products": [file]})
    assert verdict(run).headline.startswith(
        "2 criteria warn (a.hdr: reading by other programs, 2 findings);"
    )
    rows = [row for row in status_table(run).rows if row[0] == "Products"]
    assert [row[2] for row in rows] == ["no parity", "no CRVAL"]


def test_a_finding_of_several_files_is_one_row_of_the_products(converged):
    both = "note: PEDIGREE is missing"
    files = [written("a.fits", "IDCTAB", both, a_dmax=2.0), written("b.fits", "D2IMFILE", both)]
    rows = product_table(converged.having(summary={"products": files})).rows
    assert [row[:3] for row in rows] == [
        ("a.fits", "IDCTAB", "A_DMAX (pix)"),
        ("b.fits", "D2IMFILE", "–"),
        ("a.fits, b.fits", "–", "reading by other programs"),
    ]


def test_the_headline_names_the_epoch_of_the_verdicts(converged):
    assert {m.epoch for m in converged.evaluation.margins} == {2010.3}
    assert (
        "every requirement is met at epoch 2010.30"
        in verdict(_met_only(converged)).headline.lower()
    )


@pytest.mark.parametrize(
    ("end", "began", "level", "words"),
    [
        (2015.3, "2012-07-01T00:00:00+00:00", "pass", "ends in 2015.3"),
        (2015.3, "2016-07-01T00:00:00+00:00", "warn", "ended in 2015.3"),
        (2030.0, "2012-07-01T00:00:00+00:00", "pass", "lasts at least until 2020.3"),
        (2005.0, "2012-07-01T00:00:00+00:00", "warn", "has ended with the data"),
    ],
)
def test_the_validity_period_counts_and_stands_in_the_status_table(
    converged, end, began, level, words
):
    good = _met_only(converged)
    run = good.having(validity=(_period(good, end),), provenance={"created": began})
    found = verdict(run)
    assert found.level == level and words in found.headline
    (row,) = status_checks(run)["Validity"]
    assert row.level == level
    if 2010.3 < end < 2020.3:
        assert f"until {end:.1f}" in row.value


def test_what_keeps_a_verdict_open_stands_in_its_row(converged):
    (met,) = _met_only(converged).evaluation.margins[:1]
    run = converged.having(margins=(replace(met, verdict="undecided", reason="too few draws"),))
    (row,) = status_checks(run)["Requirements"]
    assert row.level == "warn" and row.value.endswith("; undecided: too few draws")
    doubt = Check("Fit", "Odd stars", "three", "none", "warn", "stars are odd", LARGER)
    doubted = status_checks(run.having(checks=(*run.evaluation.checks, doubt)))
    (row,) = doubted["Requirements"]
    assert row.value.endswith("; undecided: see “Odd stars”") and doubt in doubted["Fit"]


@pytest.mark.parametrize("group", sorted(set(GROUPS) - {"Requirements", "Validity", "Products"}))
def test_every_group_of_checks_has_its_rows_and_a_section(converged, group):
    row = Check(group, "Odd stars", level="warn", sentence="stars are odd")
    run = _met_only(converged).having(checks=(row,))
    assert verdict(run).headline.startswith("One criterion warns (Odd stars)")
    assert [cells[2] for cells in status_table(run).rows if cells[0] == group] == ["Stars are odd"]
    assert section_of(group) in {section.name for section in REPORT.sections}


def test_an_error_of_the_catalogue_that_is_not_stated_is_amber(converged):
    good = _met_only(converged)
    for stated, level in ((True, "pass"), (False, "warn")):
        run = good.having(checks=(*good.evaluation.checks, *catalogue_checks(stated)))
        (row,) = status_checks(run)["Assumptions"]
        assert row.level == level == verdict(run).level
    assert not list(catalogue_checks(None))
