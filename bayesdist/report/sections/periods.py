"""Change with time, and difference from the release that a calibration replaces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesdist.report.contents import REPORT, Plot, needed
from bayesdist.report.figures.arrows import CHANCE, Arrows, magnification_of, spacing, vector_map
from bayesdist.report.figures.commands import difference_vectors
from bayesdist.report.figures.panels import ChipPanels
from bayesdist.report.figures.style import nice_below
from bayesdist.report.run import ReportedRun, mosaic_of, on_chip, position_text, scale_mas
from bayesdist.report.texttable import TextTable, listing, tabulated
from bayesdist.utils.text import (
    MISSING,
    count,
    display_scale,
    number,
    percent,
    probability,
    rounded,
    size_of,
    with_mas,
)

if TYPE_CHECKING:
    from bayesdist.diagnose.periods import TimeVariation
    from bayesdist.diagnose.residuals.tables import StatisticsTable

GRID = 17  # number of vectors along the longer side
_CLEAR = 3.0  # sigmas above which a coefficient is significant

ERRORS = {
    "both": "The errors of both are taken as independent.",
    "A": "The release states no errors and is taken for exact.",
    "B": "This run states no errors and is taken for exact.",
    "none": "Neither states errors.",
}


@REPORT.table("periods", needs=("diagnostics.periods",))
def period_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables of the verdict, the periods, coefficients of the first and last, and residuals."""
    variation = needed(run.diagnostics.periods)
    out = [_verdict(variation), _periods(variation, run), _coefficients(variation)]
    for chip, table in zip(variation.comparison.model.chips, variation.residuals, strict=True):
        out.append(_residuals(table, on_chip(run, chip)))
    return (*out, _patterns(variation, run))


def _verdict(found: TimeVariation) -> TextTable:
    comparison = found.comparison
    return listing(
        "Does the distortion change?",
        {
            "Models": found.verdict,
            "Residuals": found.pattern_sentence,
            "Errors": f"All quoted errors are multiplied by {number(comparison.error_scale)}, with"
            " which the models of the periods have a chi-square of 1 for each degree of freedom.",
            **({"To be known": " ".join(found.cautions)} if found.cautions else {}),
        },
    )


def _periods(found: TimeVariation, run: ReportedRun) -> TextTable:
    comparison, mas = found.comparison, scale_mas(run)
    rows = []
    ends = (found.last, found.first, found.ends)
    each = [(name, None, found.changes[name]) for name in comparison.names]
    for name, against, change in (*each, ends):
        z = np.abs(comparison.coefficients(name, against).z)
        start, stop = found.spans[name]
        n = comparison.counts[comparison.names.index(name)]
        single = against is None
        rows.append(
            {
                "Period (MJD)": name if single else f"{name} against {against}",
                "Year": f"{(start + stop) / 2:.3f}" if single else MISSING,
                "Pairs": count(n) if single else MISSING,
                "Largest difference": with_mas(change.largest, run.model.unit, mas),
                "σ there": with_mas(change.sigma, run.model.unit, mas, 2),
                "At pixel": position_text(run, change.at, change.chip),
                "95 % of noise": with_mas(change.noise_95, run.model.unit, mas),
                "p of the largest": probability(change.p_value),
                "p of the field": probability(change.p_field),
                f"Coefficients beyond {_CLEAR:g} σ, largest": (
                    f"{int((z > _CLEAR).sum())} of {len(z)}, {number(z.max(), 2)}"
                ),
            }
        )
    chance = 2 * comparison.means.shape[1] * 0.00135
    return tabulated(
        "Models of the periods against the combined model",
        rows,
        words=(0, 5, 7, 8),
        note="95 % of noise: what noise alone makes of the largest difference over the array, which"
        " p of the largest refers to; p of the field is that of all coefficients together."
        f" By chance {number(chance, 2)} coefficients of a row lie beyond {_CLEAR:g} σ.",
    )


def _coefficients(found: TimeVariation) -> TextTable:
    change = found.comparison.coefficients(found.last, found.first)
    scale = display_scale(found.comparison.model.unit, change.sigma)
    rows = []
    for k, name in enumerate(change.names):
        difference, sigma = change.difference[k] * scale.factor, change.sigma[k] * scale.factor
        cells = (rounded(difference, sigma), number(sigma, 2), number(change.z[k], 2))
        rows.append((name, *cells, number(change.p_value[k], 2)))
    half = (len(rows) + 1) // 2
    blank = ("",) * 5
    paired = [(*rows[k], *(rows[k + half] if k + half < len(rows) else blank)) for k in range(half)]
    heads = ("Coefficient", f"Difference [{scale.unit}]", "σ", "z", "p")
    return TextTable(
        f"Legendre coefficients: {found.last} minus {found.first}",
        (*heads, *heads),
        tuple(paired),
        words=(0, 5),
        note="Differences of the other periods from the combined model, and monomial ones:"
        " periods.ecsv.",
    )


def _residuals(table: StatisticsTable, on_chip: str) -> TextTable:
    """Table of residual statistics, as Table C-1 of WSDC D-T033."""
    unit = table.unit
    names = ("mean", "sigma", "min", "max", "median", "p01", "p99")
    heads = ("Mean", "σ", "Min", "Max", "Median", "1 %", "99 %")
    rows = [
        (
            row.label,
            *(rounded(row.value[n], row.error[n]) for n in names),
            number(row.error["sigma"], 2),
            number(row.noise_free["sigma"], 3),
        )
        for row in table.rows
    ]
    first = table.rows[0]
    return TextTable(
        f"Mean residuals of bins{on_chip} about the one model of all data [{unit}]",
        ("Period/axis", *heads, "σ of σ", "σ, no noise"),
        tuple(rows),
        note=f"{count(first.n_bins)} bins. A drift would make the residuals of all periods"
        " together wider than those of one, beyond what noise adds to the smaller sets: compare"
        " the last column.",
    )


def _patterns(found: TimeVariation, run: ReportedRun) -> TextTable:
    rows = []
    for chip, several in zip(found.comparison.model.chips, found.patterns, strict=True):
        for pattern in several:
            head = f"{pattern.period}/{pattern.axis}{on_chip(run, chip)}"
            rms = with_mas(pattern.rms, run.model.unit, scale_mas(run), 2)
            cells = (
                number(pattern.p_value, 2),
                rms,
                number(pattern.correlation, 2),
                count(pattern.n_bins),
            )
            rows.append((head, *cells))
    return TextTable(
        "Patterns of the residuals: each period against all the others",
        ("Period/axis", "p", "rms of the differences, no noise", "Correlation", "Bins"),
        tuple(rows),
        note="p: probability of such differences of the bins by chance. The correlation is near 1"
        " where one pattern stays that stands out of the noise.",
    )


@REPORT.figure(
    "periods", needs=("diagnostics.periods",), printed=lambda run: run.kind.words.prints_data
)
def period_differences(run: ReportedRun) -> Plot:
    """Map of the latest model minus the earliest one.

    Vectors that noise would make as long at their position in more than 5 % of cases are pale.
    """
    result = needed(run.diagnostics.periods)
    comparison, unit = result.comparison, result.comparison.model.unit
    longest = mosaic_of(run).longest_side
    chips, lengths = [], []
    for chip in comparison.model.chips:
        nx, ny = (max(3, round(GRID * side / longest)) for side in chip.size)
        f = comparison.field(result.last, result.first, chip=chip, grid=(nx, ny))
        gx, gy = (a.ravel() for a in np.meshgrid(f.x, f.y))
        clear = (f.p_value < CHANCE).ravel()
        chips.append(Arrows(gx, gy, f.du.ravel(), f.dv.ravel(), spacing(f.x, f.y), clear))
        lengths.append(float(chips[-1].length.max()))
    largest = max(lengths)
    M = magnification_of(2.0 * min(arrows.step for arrows in chips), largest)
    panels = ChipPanels(mosaic_of(run))
    panels.frame(0.02 * longest + M * largest)
    titles = [
        panels.title(k, f"MJD {result.last} − {result.first},\nlargest {size_of(here, unit)}")
        for k, here in enumerate(lengths)
    ]
    vector_map(panels, chips, titles, magnification=M, key=nice_below(largest / 1.5), unit=unit)
    change, mas = result.ends, scale_mas(run)
    size = with_mas(change.largest, run.model.unit, mas)
    return Plot(
        panels.figure,
        "Difference of the latest and the earliest period",
        f"Positions by the model of {result.last} minus those by the model of {result.first}. Dark"
        " vectors differ from zero beyond 2 σ at their position (both axes together); neighbours"
        f" share their coefficients and are dark together. The largest is {size} at pixel"
        f" {position_text(run, change.at, change.chip)}; noise alone makes up to"
        f" {with_mas(change.noise_95, run.model.unit, mas)} in 95 of 100 cases"
        f" ({probability(change.p_value)}).",
        f"Map of difference vectors between two periods; the largest is {size}.",
    )


@REPORT.table("previous", needs=("previous",))
def previous_table(run: ReportedRun) -> TextTable:
    """Table of the difference of each chip, its significance, and what was removed."""
    rows = []
    for comparison in run.previous:
        mas = comparison.frame.pixel_mas or scale_mas(run)
        field, similarity = comparison.field, comparison.similarity
        verdict = {True: "differs", False: "within the errors", None: "not tested"}[
            comparison.differs
        ]
        chip = next(
            (c for c in run.model.chips if c.number == comparison.a.chip),
            run.model.chips[0],
        )
        shift = None if similarity.shift is None else float(np.hypot(*similarity.shift))
        scale = percent(similarity.scale - 1.0, 2) if similarity.same_unit else MISSING
        rows.append(
            {
                "Chip": chip.name or str(chip.number),
                "rms": with_mas(comparison.rms, "pix", mas),
                "Largest": with_mas(comparison.largest, "pix", mas),
                "At pixel": "({:.0f}, {:.0f})".format(*comparison.position_of_largest),
                "Chi-square (dof)": MISSING
                if field is None
                else f"{number(field.chi2)} ({field.dof})",
                "p": MISSING if field is None else number(field.p_value, 2),
                "Shift [pix]": number(shift),
                "Scale − 1": scale,
                "Rotation [°]": number(float(np.degrees(similarity.rotation)), 3),
                "Result": verdict,
            }
        )
    first = run.previous[0]
    return tabulated(
        f"This run minus {first.b.name}",
        rows,
        words=(0, 9),
        stacked=(9,),
        note="Differences are in pixels without distortion. Shift, rotation and scale are stated by"
        f" themselves and taken out of the rest. {ERRORS[first.errors_of]}",
    )


@REPORT.figure("previous", needs=("previous",), printed=True)
def previous_difference(run: ReportedRun) -> Plot:
    """Vectors of the run minus the release that it replaces, without shift, rotation and scale."""
    worst = max(run.previous, key=lambda found: found.largest)
    size = with_mas(worst.largest, "pix", worst.frame.pixel_mas or scale_mas(run))
    shades = " Shades are the significance of each position separately." if worst.field else ""
    return Plot(
        difference_vectors(run.previous, names=("this run", "previous")),
        "Difference from the previous release",
        f"Vectors of this run minus {worst.b.name}, at most {size}, after shift, rotation and scale"
        f" between both.{shades}",
        f"Vector diagram of the difference from the previous release, at most {size}.",
    )
