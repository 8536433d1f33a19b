"""Tables 5-1 to 5-3 as text, each with the contributions to its sigmas."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bayesdist.diagnose.residuals.tables import STATISTICS
from bayesdist.missions.wise.assess.account import RowAccount
from bayesdist.missions.wise.assess.published import HEADS, PrintedRow
from bayesdist.missions.wise.bands.context import BANDS, BandsInput
from bayesdist.report.texttable import TextTable
from bayesdist.utils.numbers import MISSING, number, rounded

TITLES = {
    "5-1": "Residuals of the fit in bins",
    "5-2": "Alignment of two bands observed together",
    "5-3": "Alignment within a band in many frames, all pairs of bins",
}


@BANDS.table("tables")
def tables_of(inputs: BandsInput) -> Sequence[TextTable]:
    """Tables 5-1 to 5-3, each with the contributions to its sigmas."""
    return [
        make_table(name, inputs)
        for name in inputs.tables
        for make_table in (statistics_table, account_table)
    ]


def statistics_table(name: str, inputs: BandsInput) -> TextTable:
    """Residual table with values, errors, noise-free values, and published values."""
    table = inputs.tables[name]
    rows: list[tuple[str, ...]] = []
    for account in inputs.accounts[name]:
        row = account.row
        values = [f"{rounded(row.value[s], row.error[s])}" for s in STATISTICS]
        errors = [f"± {number(row.error[s], 2)}" if row.error[s] else MISSING for s in STATISTICS]
        free = [rounded(row.noise_free[s], row.error[s]) for s in STATISTICS]
        rows += [(row.label, "found", *values), ("", "error", *errors), ("", "noise-free", *free)]
        if account.printed is not None:
            rows.append(("", "published", *(as_printed(account.printed, s) for s in STATISTICS)))
    number_of = f"Table {name}. " if inputs.wise else ""
    title = f"{number_of}{TITLES[name]}, {inputs.n_bins} × {inputs.n_bins} bins ({table.unit})"
    note = ""
    if name != "5-3" and any(account.printed is not None for account in inputs.accounts[name]):
        note = (
            "Found: the reference star minus the calibrated detection. The published tables give"
            " WISE minus 2MASS: means and medians have the opposite sign, and minima and 1 %"
            " correspond to maxima and 99 %."
        )
    return TextTable(
        title, (table.first, "", *HEADS.values()), tuple(rows), words=(0, 1), note=note
    )


def as_printed(row: PrintedRow, statistic: str) -> str:
    """Published value with its published number of digits."""
    decimals = round(-np.log10(2 * row.rounding[statistic]))
    return f"{row.value[statistic]:.{max(decimals, 0)}f}".replace("-", "−")


def account_table(name: str, inputs: BandsInput) -> TextTable:
    """Table of the contributions to each sigma, and of its difference from the published one."""
    unit = inputs.tables[name].unit
    row_accounts = inputs.accounts[name]
    printed = any(account.printed is not None for account in row_accounts)
    columns = [inputs.tables[name].first, "Sigma", "Noise", "Partition", "Remainder"]
    if printed:
        columns += ["Published", "Its noise", "Its structure", "Excess", "Likely reason"]
    note = "sigma² = noise² + partition² + remainder²; the partition is included if one was found."
    if printed:
        note += (
            " The noise of a published sigma follows from the published radial mean and the number"
            " of pairs, for errors that are normal or distributed as in these data; the excess is"
            " the difference of the structures in quadrature."
        )
    return TextTable(
        f"Contributions to sigma ({unit})",
        tuple(columns),
        tuple(tuple(_account(account, printed=printed)) for account in row_accounts),
        words=(0, 9),
        note=note,
    )


def _account(one: RowAccount, *, printed: bool) -> Iterator[str]:
    yield one.row.label
    for value in (one.row.value["sigma"], one.row.sigma_noise, one.partition, one.rest):
        yield number(value, 3)
    if not printed:
        return
    if one.printed is None:
        yield from (MISSING,) * 5
        return
    yield as_printed(one.printed, "sigma")
    low, high = (number(noise, 2) for noise in one.printed_noise or (None, None))
    yield low if low == high else f"{low} to {high}"
    yield number(one.printed_structure, 2)
    yield number(one.remains, 2)
    yield _why(one)


def _why(one: RowAccount) -> str:
    if any("sigma" in sentence for sentence in one.contradictions):
        return "the published sigma contradicts other rows"
    if one.verdict == "same":
        return "structure is the same within its error"
    if one.verdict == "below noise":
        return "published errors have another distribution"
    larger_set = "the published set" if one.verdict == "print has more" else "this set"
    if one.row.label.endswith("/radial"):
        return f"the scatter of stars varies more over the array in {larger_set}"
    if "-" in one.row.label:
        return f"errors of the two bands are larger or less similar in {larger_set}"
    return f"{larger_set} has additional systematic errors"


@BANDS.table("tables")
def contradiction_table(inputs: BandsInput) -> TextTable | None:
    """Table of contradictions within and between published rows; None if there are none."""
    rows = [
        (f"Table {name}", sentence)
        for name, row_accounts in inputs.accounts.items()
        for account in row_accounts
        for sentence in account.contradictions
    ]
    if not rows:
        return None
    return TextTable(
        "Contradictions within the published tables", ("", ""), tuple(rows), words=(0, 1)
    )
