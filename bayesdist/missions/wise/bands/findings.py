"""Tables of what was found of each band, as text."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.missions.wise.assess.account import LONGEST_DIFFERENCES
from bayesdist.missions.wise.bands.context import BANDS, BandResult, BandsInput, Printed
from bayesdist.missions.wise.bands.curves import CASES, below_draws, chance_of
from bayesdist.report.sections.run.status import Verdict
from bayesdist.report.texttable import TextTable, listing
from bayesdist.utils.numbers import MISSING, count, number, percent, probability, size_of

SAME_VECTOR = 0.005  # of the printed maximum


@BANDS.table("overview")
def overview_table(inputs: BandsInput) -> TextTable:
    """A line for each band, what matters most."""
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
    here = b.printed
    yield number(b.vectors.length_max if here is None else here.longest_vector_here, 4)
    if wise and here is not None:
        apart = _apart(here)
        yield number(here.longest_vector, 4)
        mark = "✗" if _differs(b, here) else "(within 2 σ)"
        yield f"{percent(apart, 2)} {'✓' if abs(apart) <= SAME_VECTOR else mark}"
    yield _length(b, float(b.posterior_map.per_axis.max()))


def _apart(here: Printed) -> float:
    """Fraction by which the longest vector is longer than the printed one."""
    return here.longest_vector_here / here.longest_vector - 1


def _differs(b: BandResult, here: Printed) -> bool:
    """True if the longest vector is not the printed one, nor within twice its error of it."""
    error = 2 * b.posterior_map.radius_max / here.longest_vector
    return abs(_apart(here)) > max(SAME_VECTOR, error)


def verdict(inputs: BandsInput) -> Verdict:
    """Verdict on all bands: convergence, structure in the residuals, and published values."""
    structure = [b.name for b in inputs.bands if _has_structure(b)]
    printed = [(b, b.printed) for b in inputs.bands if b.printed is not None]
    different = [b.name for b, here in printed if _differs(b, here)]
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
        what = f"{p.k} × {p.k} blocks" if p.edges_seen else "smooth"
        return f"{what}, {probability(max(p.p_value, 0.0))}"
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
                    # sigma is zero where noise alone explains it: its square has an error
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
        note="p, the probability of as much by chance, is of both axes together; the correlation"
        " length is that of their sum.",
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
        + ((_three(LONGEST_DIFFERENCES.get(both)),) if inputs.wise else ())
        for name, both, length, b in lengths
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
    """A value as it is printed, with three decimals."""
    return MISSING if value is None else f"{value:.3f}"


@BANDS.table("histograms")
def histogram_table(inputs: BandsInput) -> TextTable:
    """Half widths of the histograms, and what lies beyond them."""
    rows = []
    for b in inputs.bands:
        for case in (c for c in CASES if c in b.sums.histograms):
            one = b.sums.histograms[case]
            x, y = one.half_width()
            rows.append(
                (
                    b.name,
                    case,
                    number(x, 3),
                    number(y, 3),
                    count(one.n),
                    count(one.outside[0]),
                    count(one.outside[1]),
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
            "X beyond the histogram",
            "Y beyond it",
        ),
        tuple(rows),
        words=(0, 1),
        note="Half the width of the interval that holds 68.3 % of all pairs, false ones included.",
    )


@BANDS.table("coverage")
def coverage_table(inputs: BandsInput) -> TextTable:
    """Pairs in bins against even coverage."""
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
        note="Expected from even coverage, with its Poisson error; χ² / dof is 1 without variation"
        " beyond it.",
    )


@BANDS.table("formal")
def formal_table(inputs: BandsInput) -> TextTable:
    """Table of the largest radii, with what printed ones imply, and of the errors per axis."""
    columns = ["Band", "Radius, least squares", "Radius, posterior"]
    if inputs.wise:
        columns += ["Radius, published", "Error per pair it implies", "Half width found"]
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
        "Radius: hypot of σ x and σ y, as WSDC D-T033 has it. Per axis: rms of σ x and σ y. CE68,"
        " CE95: radii of the circles that hold 68 and 95 %."
    )
    if inputs.wise:
        note += (
            " A published radius implies an error of each pair if all published pairs lie evenly"
            " over the array; where it differs from the scatter found, other pairs or weights were"
            " used for it."
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
    """Table of what made the page."""
    return listing("", {key: str(value) for key, value in inputs.provenance.items()})
