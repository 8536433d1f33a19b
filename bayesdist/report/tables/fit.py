"""Tables of the linear fit and of the outlier mixture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess import residual_statistics
from bayesdist.diagnose.result import FAMILY_LEVEL, POWER
from bayesdist.infer.added_errors import DECISIVE
from bayesdist.infer.skew import skew_of
from bayesdist.report.context import ReportInput
from bayesdist.report.numbers import (
    MISSING,
    Scale,
    count,
    display_scale,
    interval,
    number,
    rounded,
    with_mas,
)
from bayesdist.report.tables.text import TextTable, listing, marked

__all__ = ["added_errors_table", "fit_tables", "outlier_table", "score_test_table"]


def fit_tables(inputs: ReportInput) -> tuple[TextTable, ...]:
    """The linear fit in figures, and statistics of its residuals."""
    fit, model, stars = inputs.fit, inputs.fit.model, inputs.stars
    mas, words = inputs.scale_mas, inputs.words
    pairs = {
        "Polynomial order": str(model.order),
        "Parameters": f"{count(model.n_params)} ({count(model.n_polynomial)} polynomial)",
        "Chips": ", ".join(c.name or str(c.number) for c in model.chips),
        "Frame of each exposure": model.frames,
        "Time-dependent terms": _drifting(inputs),
        "Chi-square / degrees of freedom": f"{number(fit.chi2, 6)} / {count(fit.dof)} ="
        f" {number(fit.chi2 / fit.dof if fit.dof > 0 else None)}",
        "rms of u": with_mas(fit.rms_u, inputs.unit, mas),
        "rms of v": with_mas(fit.rms_v, inputs.unit, mas),
        f"{words.things} used, left out".capitalize(): f"{count(fit.n_used)}, "
        f"{count(fit.n_rejected)}",
        "Condition of the scaled normal matrix": number(fit.condition, 2),
    }
    scale = display_scale(inputs.unit, [fit.rms_u, fit.rms_v])
    names = ("mean", "sigma", "min", "max", "median", "p01", "p99")
    heads = ("Mean", "σ", "Min", "Max", "Median", "1 %", "99 %")
    rows = []
    for chip, here in _chips_of_stars(inputs):
        for axis, values in zip("uv", stars.fit_residual[here].T, strict=True):
            if values.size:
                s = residual_statistics(values * scale.factor)
                rows.append((f"{chip}{axis}", *(rounded(s[k], s["sigma"] / 10) for k in names)))
    if inputs.held:
        pairs["Parameters"] += f", {count(len(inputs.held))} of them held by {words.holder}"
    return (
        listing(words.fit.capitalize(), pairs),
        *((_skew_table(inputs),) if inputs.setting("fit", "skew", False) else ()),
        TextTable(
            f"Residuals of the {words.things} used [{scale.unit}]",
            ("Chip, axis" if inputs.several else "Axis", *heads),
            tuple(rows),
            note=_residual_note(inputs),
        ),
    )


def score_test_table(inputs: ReportInput) -> TextTable | None:
    """What the residuals were asked, and what they say; None where they were not."""
    if not inputs.score_tests:
        return None
    told = [t.smallest for t in inputs.score_tests if np.isfinite(t.smallest)]
    scale = display_scale(inputs.unit, told or [1.0])
    rows = tuple(
        (
            t.name if t.unit == inputs.unit else f"{t.name}, per year",
            f"{number(t.statistic, 3)} ({number(t.dof, 3)})",
            "< 1e-300" if t.p_value < 1e-300 else number(t.p_value, 2),
            number(t.size * scale.factor, 2),
            number(t.smallest * scale.factor, 2) if np.isfinite(t.smallest) else MISSING,
            f"found: {t.remedy}" if t.significant else "nothing found",
        )
        for t in inputs.score_tests
    )
    return TextTable(
        "Score tests of the residuals",
        (
            "Test",
            "Statistic (dof)",
            "p",
            f"Size [{scale.unit}]",
            f"Would have seen [{scale.unit}]",
            "Result",
        ),
        rows,
        words=(0, 5),
        stacked=(5,),
        note=f"Found: more than chance at {FAMILY_LEVEL:g} over all these tests together (Holm)."
        " Size: rms over the detector; of the noise rms difference of its standard deviations; of"
        " the gap its drift, and of motions their rms, in a year;"
        f" beside it the smallest that would have been seen with probability {POWER:g}.",
    )


def _residual_note(inputs: ReportInput) -> str:
    notes = [f"From {inputs.sample}."] if inputs.sample else []
    if inputs.words.taken:
        notes.append(
            "The stars were fitted to these detections, so that residuals are smaller than errors."
        )
    return " ".join(notes)


def _skew_table(inputs: ReportInput) -> TextTable:
    """The skew that the linear terms of each chip hold."""
    rows = []
    for c in inputs.chips:
        for name, solution in (("least squares", inputs.fit), ("posterior", inputs.posterior)):
            if solution is None:
                continue
            skew = skew_of(solution, chip=c.chip.number)
            cells = [
                rounded(1e6 * skew.value, 1e6 * skew.sigma),
                number(1e6 * skew.sigma, 2),
                number(skew.significance, 3),
            ]
            if name == "posterior":
                cells = [marked(inputs, text) for text in cells]
            rows.append((f"{c.chip.name}, {name}" if inputs.several else name, *cells))
    note = "The angle from the image of a row to that of a column is 90° plus the skew. It is held"
    note += " by the linear terms, which are all free: beside them there is no further parameter."
    weight = inputs.setting("fit", "radial_weight", 1.0)
    if weight != 1.0:
        note += (
            f" With {weight:g} times the weight in the corners the weights of the fit are not the"
            " inverse variances: its σ allows for that, but is larger than it need be, and"
            " chi-square does not test a skew of zero."
        )
    return TextTable(
        "Skew of the axes at the reference pixel [10⁻⁶ rad]",
        ("Chip, solution" if inputs.several else "Solution", "Skew", "σ", "Skew / σ"),
        tuple(rows),
        note=note,
    )


def _drifting(inputs: ReportInput) -> str:
    """Terms whose drift was asked for, and which constants may step beside them."""
    model = inputs.fit.model
    time = model.time
    if time is None:
        return "none"
    drift = inputs.setting("model", "tdd", {})
    asked = [tuple(term) for term in drift.get("terms", time.terms)]
    text = ", ".join(f"{a}_{i}_{j}" for a, i, j in asked)
    steps = {
        p.chip
        for p in model.parameters
        if p.kind == "tdd"
        and (p.i, p.j) == (0, 0)
        and (p.axis, p.i, p.j) not in asked
        and p.name not in inputs.held
    }
    if not steps:
        return text
    chips = ", ".join(c.name for c in model.chips if c.number in steps)
    breaks = ", ".join(f"{b:.2f}" for b in time.breaks)
    return f"{text}; besides, the constants of {chips} may step at {breaks}"


def _chips_of_stars(inputs: ReportInput) -> list[tuple[str, NDArray[np.bool_]]]:
    """Stars (N,) used of all chips and, where there are several, of each; what rows begin with."""
    table, used = inputs.stars.table, inputs.stars.used
    if not inputs.several:
        return [("", used)]
    numbers = table.chip_number
    each = [(f"{c.chip.name}, ", used & (numbers == c.chip.number)) for c in inputs.chips]
    return [("all, ", used), *each]


def added_errors_table(inputs: ReportInput) -> TextTable | None:
    """Errors beyond the quoted ones, by the groups that the evidence asks for; None without."""
    found = inputs.added_errors
    if found is None:
        return None
    scale = display_scale(inputs.unit, found.sigma)
    rows = []
    for g, label in enumerate(found.labels):
        for a, axis in enumerate("uv" if found.by_axis else ("u and v",)):
            size, error = scale.factor * found.sigma[g, a], scale.factor * found.sigma_error[g, a]
            rows.append(
                (
                    f"{found.by} {label}" if found.by else "all",
                    axis,
                    count(found.n[g, a]),
                    rounded(size, error),
                    number(error, 2),
                    number(scale.factor * found.excess[g, a], 3),
                )
            )
    gains = ", ".join(f"by {name} {number(gain, 3)}" for name, gain in found.evidence.items())
    note = (
        "Restricted likelihood of the residuals, false matches allowed for. ln evidence over one"
        f" error for both axes: {gains}; groups are formed from {number(DECISIVE)} on."
    )
    if found.added is not None:
        note += " What is beyond the least was added to the quoted errors, and j is the least."
    heads = ("Stars", "Axis", "Number", f"Error [{scale.unit}]", "σ", "Added to the quoted errors")
    return TextTable("Errors beyond the quoted ones", heads, tuple(rows), words=(0, 1), note=note)


def outlier_table(inputs: ReportInput) -> TextTable | None:
    """The mixture's own parameters, and how many stars or detections it flags."""
    post, words = inputs.posterior, inputs.words
    if post is None:
        return None
    named = {
        "f": (f"Fraction of {words.false}, f", ""),
        "j": ("Jitter, j: error beyond the quoted one", inputs.unit),
        "s_out": (f"Scale of the {words.false}, s_out", inputs.unit),
    }
    rows = []
    for key, (name, unit) in named.items():
        if key not in post.hyper:
            continue
        draws = np.asarray(post.hyper[key], float)
        scale = display_scale(unit, draws) if unit else Scale(1.0, "fraction")
        v = draws * scale.factor
        low, high = np.quantile(v, [0.025, 0.975])
        sd = float(v.std())
        cells = (rounded(v.mean(), sd), number(sd, 2), interval(low, high, sd))
        rows.append((name, *(marked(inputs, c) for c in cells), scale.unit))
    things, missing = words.things, (MISSING, MISSING)
    flagged = marked(inputs, count(post.n_flagged))
    rows.append(
        (f"{things.capitalize()} flagged (probability above 0.5)", flagged, *missing, things)
    )
    expected = marked(inputs, number(post.n_false, 4))
    rows.append(
        (
            f"{words.false.capitalize()} expected (sum of the probabilities)",
            expected,
            *missing,
            things,
        )
    )
    mixture, grouped = post.mixture, inputs.added_errors
    note = f"Outlier component: {mixture.model}"
    if mixture.match_radius is not None:
        note += f", match radius {number(mixture.match_radius)} {inputs.unit}"
    if mixture.jitter is not None:
        note += f"; jitter fixed at {number(mixture.jitter)} {inputs.unit}"
    a, b = mixture.fraction_prior
    if mixture.jitter_scale is not None:
        note += f"; prior of j: scale {number(mixture.jitter_scale)} {inputs.unit}"
    if mixture.outlier_scale is not None:
        note += f"; prior of s_out: about {number(mixture.outlier_scale)} {inputs.unit}"
    note += "." if mixture.model == "none" else f"; prior of f: Beta({a:g}, {b:g})."
    if grouped is not None and grouped.added is not None:
        note += f" Errors differ by {grouped.grouping}: j is the least of those beyond the quoted."
    return TextTable(
        "Outlier mixture",
        ("Quantity", "Mean", "sd", "95 % interval", "Unit"),
        tuple(rows),
        words=(0, 4),
        note=note,
    )
