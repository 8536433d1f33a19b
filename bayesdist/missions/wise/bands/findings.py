"""Tables and verdict of the page that compares bands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.missions.wise.assess.account import LONGEST_DIFFERENCES
from bayesdist.missions.wise.bands.context import BANDS, BandResult, BandsInput, Printed
from bayesdist.missions.wise.bands.curves import CASES, below_draws, chance_of
from bayesdist.report.sections.run.status import Verdict
from bayesdist.report.texttable import TextTable, listing
from bayesdist.utils.numbers import MISSING, count, number, percent, probability, size_of

SAME_VECTOR = 0.005  # relative difference up to which the longest vector agrees with the published


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
