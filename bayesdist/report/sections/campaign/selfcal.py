"""Self-calibration: its gauge, the matching of exposures and stars, and the stars."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from bayesdist.assess.maps import per_axis
from bayesdist.report.contents import REPORT, Plot
from bayesdist.report.context import ReportInput, SelfcalResults, needed
from bayesdist.report.figures.style import CYCLE, INK, PALE, WIDTH, new_figure
from bayesdist.report.texttable import MAX_ROWS, TextTable, further, listing, tabulated
from bayesdist.utils.numbers import MISSING, count, display_scale, number, percent, with_mas

if TYPE_CHECKING:
    from astropy.table import Table

MAX_STARS_DRAWN = 20_000  # more would overlap
ONE_AXIS = 0.5**0.5  # converts a radius hypot(sigma_u, sigma_v) to an error per axis


@REPORT.table("selfcal", needs=("selfcal",))
def selfcal_tables(r: ReportInput) -> tuple[TextTable, ...]:
    """Tables of the gauge, the detections, the exposures and the stars."""
    results = needed(r.selfcal)
    return (_gauge(results), _detections(results), _exposures(results, r), _stars(results, r))


def _gauge(found: SelfcalResults) -> TextTable:
    rows = [
        {
            "Property": _property(str(row["name"])),
            "From detections": str(row["state"]),
            "σ from these": _sigma(row["sigma_detections"], row["unit"]),
            "σ as fixed": _sigma(row["sigma_fixed"], row["unit"]),
            "at the edge [pix]": _edge(row["sigma_fixed"], row["edge_pix"]),
            "Fixed by": "" if np.ma.is_masked(row["fixed_by"]) else str(row["fixed_by"]),
        }
        for row in found.gauge
    ]
    return tabulated(
        "Degeneracies of the detections, and the constraints that remove them",
        [{key: text or MISSING for key, text in row.items()} for row in rows],
        words=(0, 1, 5),
        note=f"{found.words} Relative positions do not depend on any of it: their errors are in"
        " the maps of that name.",
    )


def _property(name: str) -> str:
    """Name of a direction in words; names of coefficients are unchanged."""
    return name if re.search(r"_\d", name) else name.replace("_", " ")


def _sigma(value: Any, unit: Any) -> str:
    value, unit = float(value), "" if np.ma.is_masked(unit) else unit  # of a ratio there is none
    return f"{number(value, 2)} {unit}".strip() if np.isfinite(value) else MISSING


def _edge(sigma: Any, edge: Any) -> str:
    value = float(sigma) * float(edge)
    return number(value, 2) if np.isfinite(value) else MISSING


def _detections(found: SelfcalResults) -> TextTable:
    s = found.summary
    d = s["detections"]
    return listing(
        "Detections and stars",
        {
            "Detections read": count(d["read"]),
            **{f"Cut: {reason}": count(n) for reason, n in d["cut"].items()},
            **{reason[0].upper() + reason[1:]: count(n) for reason, n in d["unused"].items()},
            "Detections used": count(d["used"]),
            "Stars": count(s["n_stars"]),
            "Detections of a star, median and most": f"{s['per_star']['median']:g}, "
            f"{count(s['per_star']['most'])}",
            "Ambiguous groups": count(s["n_ambiguous"]),
            "Rounds of grouping and solving": count(s["iterations"]),
        },
    )


def _exposures(found: SelfcalResults, r: ReportInput) -> TextTable:
    rows = [
        {
            "Exposure": str(row["exposure"]),
            "Detections": count(row["detections"]),
            "In common": percent(float(row["fraction_common"])),
            "rms on an axis [pix]": number(float(row["rms"])),
            f"Shift u [{r.unit}]": number(float(row["shift_u"]), 6),
            f"Shift v [{r.unit}]": number(float(row["shift_v"]), 6),
            "Rotation [deg]": number(float(row["rotation"]), 6),
        }
        for row in found.matching[:MAX_ROWS]
    ]
    return tabulated(
        "Exposures",
        rows,
        note="In common: of the detections that lie where another exposure looks. "
        + further(len(found.matching)),
        detail=True,
    )


def _stars(found: SelfcalResults, r: ReportInput) -> TextTable:
    s = found.summary["stars"]
    mas = r.scale_mas
    return listing(
        "The catalogue of the stars",
        {
            "Stars": count(s["n"]),
            "Error per axis, median": with_mas(ONE_AXIS * s["radius_median"], s["unit"], mas),
            "The same for a known distortion": with_mas(
                ONE_AXIS * s["radius_own_median"], s["unit"], mas
            ),
            "With two detections alone": count(s["n_two_detections"]),
            "Doubtful": count(s["n_doubtful"]),
            "Reference stars": count(s["n_reference"]),
        },
        note="All stars with their covariances: stars.ecsv. Their errors hold those of distortion"
        " and exposures, which all stars share, in the gauge of the run.",
    )


@REPORT.figure("selfcal", needs=("selfcal",))
def selfcal(r: ReportInput) -> Plot:
    """The field with its exposures, and the errors of the stars."""
    results = needed(r.selfcal)
    stars = results.stars[:: max(1, -(-len(results.stars) // MAX_STARS_DRAWN))]
    fig = new_figure(WIDTH, 0.5 * WIDTH)
    field, errors = fig.subplots(1, 2)
    field.plot(stars["u"], stars["v"], ".", ms=1.5, color=PALE, mec="none", zorder=1)
    strong = (0.4, 0.5) if len(results.outlines) > 30 else (0.9, 0.9)
    field.add_collection(
        LineCollection(results.outlines, colors=CYCLE[0], linewidths=strong[0], alpha=strong[1])
    )
    field.set_aspect("equal")
    field.autoscale_view()
    field.set_xlabel(f"u [{r.unit}]")
    field.set_ylabel(f"v [{r.unit}]")
    field.set_title(f"{count(len(results.matching))} exposures")
    _errors(errors, stars, r.unit)
    for ax in (field, errors):
        ax.tick_params(colors=INK)
    s = results.summary["stars"]
    size = with_mas(ONE_AXIS * s["radius_median"], s["unit"], r.scale_mas)
    return Plot(
        fig,
        "Exposures and stars",
        f"Outlines of the exposures over the {count(s['n'])} stars that were found, and the errors"
        f" of these per axis (1 σ), {size} at the median, in the gauge of the run.",
        f"Outlines of exposures over stars, and errors of the stars, median {size}.",
    )


def _errors(ax: Axes, stars: Table, unit: str) -> None:
    total = per_axis(stars["sigma_u"], stars["sigma_v"])
    measured = per_axis(stars["sigma_own_u"], stars["sigma_own_v"])
    scale = display_scale(unit, float(np.median(total)))
    by_mag = "mag" in stars.colnames
    x = np.asarray(stars["mag"] if by_mag else stars["n"], float)
    for values, color, label in (
        (total, CYCLE[0], "with distortion and frames"),
        (measured, CYCLE[1], "of a known distortion"),
    ):
        ax.plot(
            x, np.asarray(values) * scale.factor, ".", ms=2, mec="none", color=color, label=label
        )
    ax.set_yscale("log")
    ax.locator_params(axis="x", integer=not by_mag)
    ax.set_xlabel("magnitude [mag]" if by_mag else "detections [count]")
    ax.set_ylabel(f"per axis (1 σ) [{scale.unit}]")
    ax.set_title("Errors of the stars")
    ax.legend(markerscale=4)
