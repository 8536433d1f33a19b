"""The headline is the worst row, names the epoch that it is of, and until when it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.assess.requirements.margins import ValidityPeriod
from bayesdist.assess.requirements.verdict import catalogue_checks
from bayesdist.report.contents import EXPLAINED, section_of
from bayesdist.report.context import Product
from bayesdist.report.sections.run.provenance import product_table
from bayesdist.report.sections.run.status import status_checks, status_table, verdict
from bayesdist.utils.checks import GROUPS, LARGER, Check

YEARS = np.linspace(2010.3, 2020.3, 41)


def _met_only(run):
    return replace(run, margins=tuple(m for m in run.margins if m.verdict == "met"))


def _period(run, end: float) -> ValidityPeriod:
    """Probability that falls from 1 to 0, and passes what is asked at `end`."""
    asked = run.margins[0].requirement
    p = np.clip(asked.probability + 0.3 * (end - YEARS), 0.0, 1.0)
    return ValidityPeriod(asked, YEARS, p, p - 0.01, p + 0.01, np.ones_like(p))


def test_a_row_that_warns_is_in_the_headline(converged):
    good = _met_only(converged)
    assert verdict(good).level == "pass"
    row = Check("Fit", "Odd stars", "three", "none", "warn")
    worse = verdict(replace(good, checks=(*good.checks, row)))
    assert worse.level == "warn" and worse.headline.startswith("One criterion warns (Odd stars)")
    failed = verdict(replace(good, checks=(*good.checks, row, replace(row, level="fail"))))
    assert failed.level == "fail" and failed.headline.startswith("One criterion fails (Odd stars)")


def test_several_findings_of_a_file_are_counted_and_the_file_named_once(converged):
    found = [Check("Products", "as read", text, "", "warn") for text in ("no parity", "no CRVAL")]
    run = replace(_met_only(converged), products=(Product("a.hdr", "SIP", tuple(found)),))
    assert verdict(run).headline.startswith("2 criteria warn (a.hdr: as read, 2 findings);")
    rows = [row for row in status_table(run).rows if row[0] == "Products"]
    assert [row[2] for row in rows] == ["no parity", "no CRVAL"]


def test_a_finding_of_several_files_is_one_row_of_the_products(converged):
    both = Check("Products", "keywords", "PEDIGREE is missing", "", "note")
    own = Check("Products", "closure", 1e-5, "", "note")
    products = (Product("a.fits", "IDCTAB", (own, both)), Product("b.fits", "D2IMFILE", (both,)))
    rows = product_table(replace(converged, products=products)).rows
    assert [row[:3] for row in rows] == [
        ("a.fits", "IDCTAB", "closure"),
        ("b.fits", "D2IMFILE", "–"),
        ("a.fits, b.fits", "–", "keywords"),
    ]


def test_the_headline_names_the_epoch_of_the_verdicts(converged):
    assert {m.epoch for m in converged.margins} == {2010.3}
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
    run = replace(good, validity=(_period(good, end),), provenance={"created": began})
    found = verdict(run)
    assert found.level == level and words in found.headline
    (row,) = status_checks(run)["Validity"]
    assert row.level == level
    if 2010.3 < end < 2020.3:
        assert f"until {end:.1f}" in row.value


def test_what_keeps_a_verdict_open_stands_in_its_row(converged):
    (met,) = _met_only(converged).margins[:1]
    run = replace(converged, margins=(replace(met, verdict="undecided", reason="too few draws"),))
    (row,) = status_checks(run)["Requirements"]
    assert row.level == "warn" and row.value.endswith("; undecided: too few draws")
    doubt = Check("Fit", "Odd stars", "three", "none", "warn", "stars are odd", LARGER)
    doubted = status_checks(replace(run, checks=(*run.checks, doubt)))
    (row,) = doubted["Requirements"]
    assert row.value.endswith("; undecided: see “Odd stars”") and doubt in doubted["Fit"]


@pytest.mark.parametrize("group", sorted(set(GROUPS) - {"Requirements", "Validity", "Products"}))
def test_every_group_of_checks_has_its_rows_and_a_section(converged, group):
    row = Check(group, "Odd stars", level="warn", sentence="stars are odd")
    run = replace(_met_only(converged), checks=(row,))
    assert verdict(run).headline.startswith("One criterion warns (Odd stars)")
    assert [cells[2] for cells in status_table(run).rows if cells[0] == group] == ["Stars are odd"]
    assert section_of(group) in EXPLAINED


def test_an_error_of_the_catalogue_that_is_not_stated_is_amber(converged):
    good = _met_only(converged)
    for stated, level in ((True, "pass"), (False, "warn")):
        run = replace(good, checks=(*good.checks, *catalogue_checks(stated)))
        (row,) = status_checks(run)["Assumptions"]
        assert row.level == level == verdict(run).level
    assert not list(catalogue_checks(None))
