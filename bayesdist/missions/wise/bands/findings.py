"""Tables and verdict of the page that compares bands.

Tables 5-1 to 5-3 are shown with the contributions to their sigmas.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bayesdist.diagnose.residuals.tables import STATISTICS
from bayesdist.missions.wise.assess.account import LONGEST_DIFFERENCES, RowAccount
from bayesdist.missions.wise.assess.residual_tables import HEADS, PrintedRow
from bayesdist.missions.wise.bands.context import BANDS, BandResult, BandsInput, Printed
from bayesdist.missions.wise.bands.figures import CASES, below_draws, chance_of
from bayesdist.report.sections.status import Verdict
from bayesdist.report.texttable import TextTable, listing
from bayesdist.utils.text import MISSING, count, number, percent, probability, rounded, size_of

SAME_VECTOR = 0.005  # relative difference up to which the longest vector agrees with the published

TITLES = {
    "5-1": "Residuals of the fit in bins",
    "5-2": "Alignment of two bands observed together",
    "5-3": "Alignment within a band in many frames, all pairs of bins",
}


@BANDS.table("overview")
def overview_table(inputs: BandsInput) -> TextTable:
    """Table of the most important results, one row per band."""
    columns = ["Band", "Converged", "Pairs", "Structure", "Longest vector (pix)"]
    if inputs.wise:
        columns += ["Published (pix)", "Difference"]
    columns += ["Largest σ per axis (pix)"]
    return TextTable(
        "Overview",
        tuple(columns),
        tuple(tuple(_overview(b, wise=inputs.wise)) for b in inputs.bands),
        words=(0, 1, 3),
    )


def _overview(b: BandResult, *, wise: bool) -> Iterator[str]:
    yield b.name
    yield "yes" if b.converged else "NO"
    yield count(b.n_pairs)
    yield _structure(b)
    printed = b.printed
    yield number(b.vectors.length_max if printed is None else printed.longest_vector_here, 4)
    if wise and printed is not None:
        apart = _apart(printed)
        yield number(printed.longest_vector, 4)
        mark = "✗" if _differs(b, printed) else "(within 2 σ)"
        yield f"{percent(apart, 2)} {'✓' if abs(apart) <= SAME_VECTOR else mark}"
    yield _length(b, float(b.posterior_map.per_axis.max()))


def _apart(here: Printed) -> float:
    """Relative difference of the longest vector from the published one."""
    return here.longest_vector_here / here.longest_vector - 1


def _differs(b: BandResult, here: Printed) -> bool:
    """True if the longest vector differs from the published one by more than twice its error."""
    error = 2 * b.posterior_map.radius_max / here.longest_vector
    return abs(_apart(here)) > max(SAME_VECTOR, error)


def verdict(inputs: BandsInput) -> Verdict:
    """Verdict on all bands: convergence, structure in the residuals, and published values."""
    structure = [b.name for b in inputs.bands if _has_structure(b)]
    printed = [(b, b.printed) for b in inputs.bands if b.printed is not None]
    different = [b.name for b, published in printed if _differs(b, published)]
    clauses = []
    if inputs.provisional:
        clauses.append(f"not converged: {', '.join(b.name for b in inputs.not_converged)}")
    if structure:
        clauses.append(f"structure is left in the residuals of {', '.join(structure)}")
    if different:
        clauses.append(
            f"the longest vector differs from the published one in {', '.join(different)}"
        )
    level = "fail" if inputs.provisional else "warn" if clauses else "pass"
    if not clauses:
        clauses.append("all bands have converged, and no structure is found in their residuals")
        if printed:
            clauses.append("the longest vectors agree with those published")
    headline = "; ".join(clauses)
    sentences = ("Requirements are judged in the report of each band's run.",)
    return Verdict(level, headline[:1].upper() + headline[1:], sentences)


def _length(b: BandResult, value: float) -> str:
    unit = b.formal_map.unit
    return number(value, 3) if unit == "pix" else size_of(value, unit)


def _has_structure(b: BandResult) -> bool:
    return b.partition.significant or below_draws(b.correlation.p_value)


def _structure(b: BandResult) -> str:
    p = b.partition
    if p.significant:
        description = f"{p.k} × {p.k} blocks" if p.edges_seen else "smooth"
        return f"{description}, {probability(max(p.p_value, 0.0))}"
    if below_draws(b.correlation.p_value):
        return f"correlated bins, {chance_of(b.correlation.p_value)}"
    return f"none found, {probability(p.p_value)}"


@BANDS.table("structure")
def structure_table(inputs: BandsInput) -> TextTable:
    """Structure left in the residuals, by band and axis."""
    rows: list[tuple[str, ...]] = []
    for b in inputs.bands:
        c, p = b.correlation, b.partition
        for k, axis in enumerate("XY"):
            row = inputs.tables["5-1"][f"{b.name}/{axis}"]
            nearest, sigma = ((c.uu, c.sigma_uu), (c.vv, c.sigma_vv))[k]
            free = row.noise_free["sigma"]
            rows.append(
                (
                    f"{b.name}/{axis}",
                    number(free, 3),
                    # the variance has an error; sigma is set to zero if it is negative
                    number(row.variance / max(row.variance_error, 1e-300), 3),
                    number(nearest[0] / sigma[0], 3),
                    number(c.reach, 3) if c.reach else MISSING,
                    chance_of(c.p_value),
                    f"{p.k} × {p.k}",
                    probability(p.p_value),
                    number(p.rms[k], 2) if p.significant else MISSING,
                    "yes" if p.edges_seen else "no",
                )
            )
    return TextTable(
        "Structure left in the residuals",
        (
            "Band/Axis",
            "Sigma without noise (pix)",
            "Its significance (σ)",
            "Correlation of neighbours (σ)",
            "Correlation length (pix)",
            "p of correlation",
            "Best partition",
            "p of partition",
            "Its rms (pix)",
            "Edges seen",
        ),
        tuple(rows),
        words=(0, 5, 6, 7, 9),
        note="p is the probability of as much structure by chance, for both axes together; the"
        " correlation length is that of their sum.",
    )


@BANDS.table("vectors")
def vector_table(inputs: BandsInput) -> TextTable | None:
    """Longest difference vectors; None for one band without an optical model."""
    first = inputs.bands[0]
    lengths = [
        (name, (later.name, first.name), v.length_max, first)
        for later, (name, v) in zip(inputs.bands[1:], inputs.differences.items(), strict=True)
    ]
    lengths += [
        (f"{b.name} − optical", (b.name, "optical"), b.minus_optical.length_max, b)
        for b in inputs.bands
        if b.minus_optical is not None
    ]
    if not lengths:
        return None
    rows = [
        (name, b.name, number(length, 4), number(length * b.arcsec, 3))
        + ((_three(LONGEST_DIFFERENCES.get(key)),) if inputs.wise else ())
        for name, key, length, b in lengths
    ]
    return TextTable(
        "Longest difference vectors",
        ("Difference", "In pixels of", "Max (pix)", "Max (arcsec)")
        + (("Published (pix)",) if inputs.wise else ()),
        tuple(rows),
        words=(0, 1),
        note=f"Optical model: {inputs.optical}." if inputs.optical else "",
    )


def _three(value: float | None) -> str:
    """Published value with three decimals, or a dash."""
    return MISSING if value is None else f"{value:.3f}"


@BANDS.table("histograms")
def histogram_table(inputs: BandsInput) -> TextTable:
    """Half widths of the histograms, and numbers of residuals outside of them."""
    rows = []
    for b in inputs.bands:
        for case in (c for c in CASES if c in b.sums.histograms):
            histogram = b.sums.histograms[case]
            x, y = histogram.half_width()
            rows.append(
                (
                    b.name,
                    case,
                    number(x, 3),
                    number(y, 3),
                    count(histogram.n),
                    count(histogram.outside[0]),
                    count(histogram.outside[1]),
                )
            )
    return TextTable(
        "Residuals of all pairs",
        (
            "Band",
            "Case",
            "Half width X (pix)",
            "Half width Y (pix)",
            "Pairs",
            "X outside the histogram",
            "Y outside it",
        ),
        tuple(rows),
        words=(0, 1),
        note="Half the width of the interval that contains 68.3 % of all pairs, including false"
        " ones.",
    )


@BANDS.table("coverage")
def coverage_table(inputs: BandsInput) -> TextTable:
    """Numbers of pairs per bin, compared with uniform coverage."""
    rows = []
    for b in inputs.bands:
        n = b.sums.bins.count
        mean = float(n.mean())
        rows.append(
            (
                b.name,
                count(b.n_pairs),
                count(n.sum()),
                f"{number(mean, 4)} ± {number(np.sqrt(mean), 2)}",
                count(n.min()),
                count(n.max()),
                number(b.coverage_chi2 / (n.size - 1), 3),
            )
        )
    heads = ("All pairs", "Used", "Expected per bin", "Fewest", "Most", "χ² / dof")
    return TextTable(
        "Coverage: pairs used by the fit, in bins",
        ("Band", *heads),
        tuple(rows),
        note="Expected for uniform coverage, with its Poisson error; χ² / dof is 1 if there is no"
        " further variation.",
    )


@BANDS.table("formal")
def formal_table(inputs: BandsInput) -> TextTable:
    """Table of the largest position errors, with the published radii and the implied pair error."""
    columns = ["Band", "Radius, least squares", "Radius, posterior"]
    if inputs.wise:
        columns += ["Radius, published", "Implied error per pair", "Half width found"]
    columns += ["Posterior per axis", "CE68", "CE95"]
    rows = []
    for b in inputs.bands:
        cells = [b.name, *(_length(b, m.radius_max) for m in (b.formal_map, b.posterior_map))]
        if inputs.wise and b.printed is not None:
            width = float(b.sums.histograms["calibrated"].half_width().mean())
            cells += [number(b.printed.formal_radius, 2), number(b.printed.implied_sigma, 3)]
            cells.append(number(width, 3))
        elif inputs.wise:
            cells += [MISSING] * 3
        m = b.posterior_map
        errors = (m.per_axis, m.circular_error(0.68), m.circular_error(0.95))
        cells += [_length(b, float(error.max())) for error in errors]
        rows.append(tuple(cells))
    note = (
        "Radius: hypot of σ x and σ y, as in WSDC D-T033. Per axis: rms of σ x and σ y. CE68,"
        " CE95: radii of the circles that contain 68 and 95 %."
    )
    if inputs.wise:
        note += (
            " A published radius implies an error per pair if all published pairs are distributed"
            " uniformly over the array; if this differs from the scatter found, other pairs or"
            " weights were used."
        )
    unit = "pix" if inputs.bands[0].formal_map.unit == "pix" else "unit as given"
    return TextTable(
        f"Largest uncertainty over the array, 1 σ ({unit})",
        tuple(columns),
        tuple(rows),
        note=note,
    )


@BANDS.table("provenance")
def provenance_table(inputs: BandsInput) -> TextTable:
    """Table of the command and the versions that made the page."""
    return listing("", {key: str(value) for key, value in inputs.provenance.items()})


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
