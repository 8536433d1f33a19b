"""Input data with errors by magnitude, and the least-squares fit: statistics and tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from bayesdist.diagnose.residuals.tables import residual_statistics
from bayesdist.diagnose.score.result import POWER
from bayesdist.infer.solution.geometry import geometries, skew_of
from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.fields import Grid, scalar_map
from bayesdist.report.figures.style import WIDTH, new_figure
from bayesdist.report.plots.residuals import draw_density
from bayesdist.report.run import (
    ReportedRun,
    has_several_chips,
    marked,
    sample_words,
    scale_mas,
    setting,
    shown_residuals,
)
from bayesdist.report.sections.maps import map_panels, map_titles
from bayesdist.report.texttable import (
    MAX_ROWS,
    TextTable,
    further,
    listing,
    short_paths,
    tabulated,
)
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.checks import SCORE_TESTS
from bayesdist.utils.text import MISSING, count, display_scale, number, rounded, with_mas

if TYPE_CHECKING:
    from bayesdist.data import MagnitudeErrors


@REPORT.table("data")
def data_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables of rows read and rejected, errors by magnitude, and exposures."""
    m, fit, words = run.diagnostics.sample.table, run.fit, run.kind.words
    partial = ", of the sample" if run.diagnostics.sample.partial else ""
    pairs = {
        "Sources": ", ".join(short_paths(m.sources)),
        "Rows read": count(m.n_rows),
        words.all_rows.capitalize(): count(run.diagnostics.sample.n_total),
        f"Used by the {words.rejection}": count(fit.n_used),
        "Unit of u, v": m.unit,
        "Exposures": count(np.count_nonzero(run.diagnostics.sums.exposures.n)),
    }
    if any(m.filter_names):
        pairs["Filters"] = ", ".join(f for f in m.filter_names if f)
    if m.epoch is not None:
        first, last = f"{np.min(m.epoch):.2f}", f"{np.max(m.epoch):.2f}"
        pairs[f"Epochs [yr]{partial}"] = first if first == last else f"{first} to {last}"
    if m.mag is not None and np.isfinite(m.mag).any():
        pairs[f"Magnitudes{partial}"] = f"{np.nanmin(m.mag):.2f} to {np.nanmax(m.mag):.2f}"
    sigma_setting = setting(run, "data", "sigma", "as given")
    pairs[f"Errors of the {words.rows}"] = (
        "by magnitude, see below"
        if run.errors.by_magnitude is not None
        else (
            str(sigma_setting)
            if isinstance(sigma_setting, str)
            else f"{sigma_setting:g} {m.unit} on each axis"
        )
    )
    reasons = [(f"{k} (reading)", count(v)) for k, v in m.rejected.items()]
    reasons += [(f"{k} ({words.rejection})", count(v)) for k, v in fit.rejected.items()]
    rejected = TextTable(
        "Rows left out, by reason",
        ("Reason", "Rows"),
        tuple(reasons) or (("none", "0"),),
        note=f"The posterior uses all {words.all_rows}: the mixture replaces rejection.",
    )
    note = f"Figures and tables of single {words.rows} show {sample_words(run)}." if partial else ""
    out = [listing("Input", pairs, note), rejected]
    if run.errors.by_magnitude is not None:
        out.append(_magnitude_table(run))
    if len(m.exposure_names) > 1:
        out.append(_exposure_table(run))
    return tuple(out)


def _magnitude_table(run: ReportedRun) -> TextTable:
    e = needed(run.errors.by_magnitude)
    scale = display_scale(run.model.unit, np.concatenate([e.sigma_u, e.sigma_v]))
    rows = [
        {
            "Magnitude": f"{mag:.2f}".replace("-", "−"),
            run.kind.words.rows.capitalize(): count(n),
            f"σ u [{scale.unit}]": number(su * scale.factor),
            f"σ v [{scale.unit}]": number(sv * scale.factor),
        }
        for mag, n, su, sv in zip(e.mag, e.n, e.sigma_u, e.sigma_v, strict=True)
    ]
    caption = "Errors by magnitude, estimated from the residuals"
    return tabulated(caption, rows, words=(), detail=True)


def _exposure_table(run: ReportedRun) -> TextTable:
    names, fit, sums = (
        run.diagnostics.sample.table.exposure_names,
        run.fit,
        run.diagnostics.sums.exposures,
    )
    scale = display_scale(run.model.unit, [fit.rms_u, fit.rms_v])
    flagged = run.diagnostics.flagged
    rows = [
        {
            "Exposure": names[k],
            run.kind.words.rows.capitalize(): count(sums.n[k]),
            "Used": count(sums.n_used[k]),
            f"rms u [{scale.unit}]": number(sums.rms[0][k] * scale.factor),
            f"rms v [{scale.unit}]": number(sums.rms[1][k] * scale.factor),
            "Outliers (P > 0.5)": MISSING if flagged is None else marked(run, count(flagged[k])),
        }
        for k in np.flatnonzero(sums.n)
    ]
    return tabulated("Exposures", rows[:MAX_ROWS], note=further(len(rows)), detail=True)


@REPORT.figure("data", when=lambda run: bool(_magnitudes(run).any()))
def residuals_by_magnitude(run: ReportedRun) -> Plot:
    """Density of the residuals against magnitude, with the errors assigned to each magnitude."""
    words, has_magnitude = run.kind.words, _magnitudes(run)
    text = f"Residuals grow towards faint stars; colour counts {words.rows}."
    if run.errors.by_magnitude is not None:
        addition = (
            ", or somewhat more, because the stars were fitted to them" if words.leverage else ""
        )
        text += " The lines are ±1 σ as assigned to each magnitude: about two thirds of the"
        text += f" {words.rows} lie between them{addition}."
    if sample_words(run):
        text += f" Drawn from {sample_words(run)}."
    return Plot(
        _density(
            needed(run.diagnostics.sample.table.mag)[has_magnitude],
            run.diagnostics.sample.residual[has_magnitude],
            unit=run.model.unit,
            errors=run.errors.by_magnitude,
            shown=f"sampled {words.rows}" if run.diagnostics.sample.partial else words.rows,
        ),
        "Residuals against magnitude",
        text,
        "Two density plots of the residuals in u and v against magnitude, widening to faint stars.",
    )


@REPORT.figure("data", printed=lambda run: run.kind.words.prints_data)
def coverage(run: ReportedRun) -> Plot:
    """Map of the number of stars in each cell of the detector."""
    grids = [
        Grid(cells.x, cells.y, np.asarray(cells.count, float)) for cells in shown_residuals(run)
    ]
    panels = map_panels(run)
    counts = np.concatenate([g.values.ravel() for g in grids])
    rows, false_rows = run.kind.words.rows, run.kind.words.false_rows
    scalar_map(
        panels,
        grids,
        map_titles(panels, grids, [lambda low, high: f"{low:.0f} to {high:.0f} a cell"]),
        norm=Normalize(0.0, max(float(counts.max()), 1.0)),
        label=f"{rows} per cell [count]",
    )
    empty = int((counts == 0).sum())
    return Plot(
        panels.figure,
        "Coverage of the detector",
        f"Number of {rows} in each cell, without likely {false_rows}: {count(empty)} of"
        f" {count(counts.size)} cells are empty, and the median is {np.median(counts):.0f}. Where"
        f" there are no {rows}, the solution is an extrapolation of the polynomial.",
        f"Map of the number of {rows} per cell; {empty} of {counts.size} cells are empty.",
    )


def _magnitudes(run: ReportedRun) -> Bool:
    """Boolean mask (N,) that is True for stars with a known magnitude."""
    mag = run.diagnostics.sample.table.mag
    return np.zeros(len(run.diagnostics.sample.table), bool) if mag is None else np.isfinite(mag)


def _density(
    mag: Float, residual: Float, *, unit: str, errors: MagnitudeErrors | None, shown: str
) -> Figure:
    """Figure with hexagons that count residuals, with a panel for each axis."""
    fig = new_figure(WIDTH, 3.2)
    axes = fig.subplots(1, 2, sharey=True)
    for ax, axis in zip(axes, "uv", strict=True):
        hexagons, scale, outside = draw_density(ax, mag, residual, axis, unit=unit, errors=errors)
        ax.set_title(f"{axis}: {outside} {shown} lie outside")
        ax.set_xlabel("magnitude [mag]")
    axes[0].set_ylabel(f"residual [{scale.unit}]")
    fig.colorbar(hexagons, ax=axes, label=f"{shown} per hexagon", fraction=0.04, pad=0.01)
    return fig


@REPORT.table("fit")
def fit_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables of the numbers of the linear fit, and of statistics of its residuals."""
    fit, model, stars = run.fit, run.model, run.diagnostics.sample
    mas, words = scale_mas(run), run.kind.words
    pairs = {
        "Polynomial order": str(model.order),
        "Parameters": f"{count(model.n_params)} ({count(model.n_polynomial)} polynomial)",
        "Chips": ", ".join(c.name or str(c.number) for c in model.chips),
        "Frame of each exposure": model.frames.replace("_", ", "),
        "Time-dependent terms": _drifting(run),
        "Chi-square / degrees of freedom": f"{count(fit.chi2)} / {count(fit.dof)} ="
        f" {number(fit.chi2 / fit.dof if fit.dof > 0 else None)}",
        "rms of u": with_mas(fit.rms_u, run.model.unit, mas),
        "rms of v": with_mas(fit.rms_v, run.model.unit, mas),
        f"{words.rows} used, left out".capitalize(): f"{count(fit.n_used)}, "
        f"{count(fit.n_rejected)}",
        "Condition of the scaled normal matrix": number(fit.condition, 2),
    }
    scale = display_scale(run.model.unit, [fit.rms_u, fit.rms_v])
    names = ("mean", "sigma", "min", "max", "median", "p01", "p99")
    heads = ("Mean", "σ", "Min", "Max", "Median", "1 %", "99 %")
    rows = []
    for chip, on_chip in _chips_of_stars(run):
        for axis, values in zip("uv", stars.fit_residual[on_chip].T, strict=True):
            if values.size:
                s = residual_statistics(values * scale.factor)
                rows.append((f"{chip}{axis}", *(rounded(s[k], s["sigma"] / 10) for k in names)))
    if run.held_parameters:
        pairs["Parameters"] += (
            f", {count(len(run.held_parameters))} of them held by {words.constraint}"
        )
    notes = [f"From {sample_words(run)}."] if sample_words(run) else []
    if words.leverage:
        notes.append(
            "The stars were fitted to these detections, so that residuals are smaller than errors."
        )
    return (
        listing(words.fit.capitalize(), pairs),
        _geometry_table(run),
        *((_skew_table(run),) if setting(run, "fit", "skew", False) else ()),
        TextTable(
            f"Residuals of the {words.rows} used [{scale.unit}]",
            ("Chip, axis" if has_several_chips(run) else "Axis", *heads),
            tuple(rows),
            note=" ".join(notes),
            detail=True,
            folded=True,
        ),
    )


def _geometry_table(run: ReportedRun) -> TextTable:
    """Table of the scales, orientation, parity and largest distortion of each chip."""
    names = {chip.number: chip.name or str(chip.number) for chip in run.model.chips}
    rows = []
    chips = geometries(run.fit)
    for chip in chips:
        x, y, _ = chip.scales
        angle = f"{chip.position_angle:.2f}".replace("-", "−")
        apart = f"{90 + np.degrees(chip.skew):.3f}"
        parity, distortion = f"{chip.parity:+d}".replace("-", "−"), number(chip.distortion, 3)
        rows.append((names[chip.chip], x, y, angle, apart, parity, distortion))
    unit = chips[0].scales[2]
    heads = (
        "Chip",
        f"Scale along x [{unit}]",
        f"Scale along y [{unit}]",
        "Position angle of +y [°]",
        "Angle from x to y [°]",
        "Parity",
        "Largest distortion [px]",
    )
    note = (
        "Least squares, at the reference pixel, without drift and frames. The position angle is"
        " from +v towards +u (on the sky: north through east); a parity of −1 is a mirror image."
        " The distortion is the deviation from the best linear map of the chip."
    )
    if len(rows) == 1:
        return listing("Geometry", dict(zip(heads[1:], rows[0][1:], strict=True)), note)
    return TextTable("Geometry", heads, tuple(rows), note=note)


def _skew_table(run: ReportedRun) -> TextTable:
    """Table of the skew in the linear terms of each chip."""
    rows = []
    for chip in run.model.chips:
        for name, solution in (("least squares", run.fit), ("posterior", run.posterior)):
            skew = skew_of(solution, chip=chip.number)
            cells = [
                rounded(1e6 * skew.value, 1e6 * skew.sigma),
                number(1e6 * skew.sigma, 2),
                number(skew.significance, 3),
            ]
            if name == "posterior":
                cells = [marked(run, text) for text in cells]
            rows.append((f"{chip.name}, {name}" if has_several_chips(run) else name, *cells))
    note = "The angle from the image of a row to that of a column is 90° plus the skew. It is held"
    note += " by the linear terms, which are all free: beside them there is no further parameter."
    weight = setting(run, "fit", "radial_weight", 1.0)
    if weight != 1.0:
        note += (
            f" With {weight:g} times the weight in the corners the weights of the fit are not the"
            " inverse variances: its σ allows for that, but is larger than it need be, and"
            " chi-square does not test a skew of zero."
        )
    return TextTable(
        "Skew of the axes at the reference pixel [10⁻⁶ rad]",
        ("Chip, solution" if has_several_chips(run) else "Solution", "Skew", "σ", "Skew / σ"),
        tuple(rows),
        note=note,
    )


def _drifting(run: ReportedRun) -> str:
    """Clause on terms with a fitted drift, and on constants that may step."""
    model = run.model
    time = model.time
    if time is None:
        return "none"
    drift = setting(run, "model", "tdd", {})
    asked = [tuple(term) for term in drift.get("terms", time.terms)]
    text = ", ".join(f"{a}_{i}_{j}" for a, i, j in asked)
    steps = {
        p.chip
        for p in model.parameters
        if p.kind == "tdd"
        and (p.i, p.j) == (0, 0)
        and (p.axis, p.i, p.j) not in asked
        and p.name not in run.held_parameters
    }
    if not steps:
        return text
    chips = ", ".join(c.name for c in model.chips if c.number in steps)
    breaks = ", ".join(f"{b:.2f}" for b in time.breaks)
    return f"{text}; besides, the constants of {chips} may step at {breaks}"


def _chips_of_stars(run: ReportedRun) -> list[tuple[str, Bool]]:
    """Row names and masks (N,) of the stars used, for all chips and, if several, for each chip."""
    table, used = run.diagnostics.sample.table, run.diagnostics.sample.used
    if not has_several_chips(run):
        return [("", used)]
    numbers = table.chip_number
    each = [(f"{chip.name}, ", used & (numbers == chip.number)) for chip in run.model.chips]
    return [("all, ", used), *each]


@REPORT.table("fit", needs=("diagnostics.score_tests",))
def score_test_table(run: ReportedRun) -> TextTable:
    """Table of the tests of the residuals and their results."""
    sizes = [t.smallest for t in run.diagnostics.score_tests if np.isfinite(t.smallest)]
    scale = display_scale(run.model.unit, sizes or [1.0])
    size, detectable = f"Size [{scale.unit}]", f"Detectable [{scale.unit}]"
    rows = [
        {
            "Test": t.name if t.unit == run.model.unit else f"{t.name}, per year",
            "Statistic (dof)": f"{number(t.statistic, 3)} ({t.dof:.4g})",
            "p": "< 1e-300" if t.p_value < 1e-300 else number(t.p_value, 2),
            size: number(t.size * scale.factor, 2),
            detectable: number(t.smallest * scale.factor, 2)
            if np.isfinite(t.smallest)
            else MISSING,
            "Result": f"found: {t.remedy}" if t.significant else "nothing found",
        }
        for t in run.diagnostics.score_tests
    ]
    n_found = sum(t.significant for t in run.diagnostics.score_tests)
    verb = "found" if n_found else "found nothing"
    count_of = f"{n_found} of {len(rows)}" if n_found else f"all {len(rows)}"
    return tabulated(
        f"Score tests of the residuals: {count_of} {verb}",
        rows,
        folded=not n_found,
        words=(0, 5),
        stacked=(5,),
        note=f"Found: p below {SCORE_TESTS.value:g} after Holm's correction for the number of"
        " tests. p allows for all that a test tried, as the periods and directions of a repeating"
        " pattern. Size: rms over the detector; of noise the rms difference of standard deviations,"
        " of gaps between chips and of motions the rms per year. Detectable: the smallest size that"
        f" is found with probability {POWER:g}.",
    )
