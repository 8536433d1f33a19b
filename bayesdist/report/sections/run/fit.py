"""Numbers of the least-squares fit, statistics of its residuals, and tests."""

from __future__ import annotations

import numpy as np

from bayesdist.diagnose.residuals.tables import residual_statistics
from bayesdist.diagnose.score.result import POWER
from bayesdist.infer.solution.geometry import geometries, skew_of
from bayesdist.report.contents import REPORT
from bayesdist.report.run import (
    ReportedRun,
    has_several_chips,
    marked,
    sample_words,
    scale_mas,
    setting,
)
from bayesdist.report.texttable import TextTable, listing, tabulated
from bayesdist.utils.arrays import Bool
from bayesdist.utils.checks import SCORE_TESTS
from bayesdist.utils.text import MISSING, count, display_scale, number, rounded, with_mas


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
