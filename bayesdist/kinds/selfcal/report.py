"""Figures and tables of self-calibrations; importing this module adds them to the report."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Table
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from bayesdist.assess.maps import per_axis
from bayesdist.files.tables import read_ecsv
from bayesdist.model.grid import outline_pixels
from bayesdist.report.contents import REPORT, PageSection, Plot
from bayesdist.report.figures.style import CYCLE, INK, PALE, WIDTH, new_figure
from bayesdist.report.run import ReportedRun, scale_mas
from bayesdist.report.texttable import MAX_ROWS, TextTable, further, listing, tabulated
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import MISSING, count, display_scale, number, percent, with_mas

if TYPE_CHECKING:  # processes that draw need nothing else of a run
    from bayesdist.app.run import Run

MAX_STARS_DRAWN = 20_000  # more would overlap
ONE_AXIS = 0.5**0.5  # converts a radius hypot(sigma_u, sigma_v) to an error per axis


@dataclass(frozen=True, eq=False)
class SelfcalData:
    """Data that the figures and tables show in addition to the artefacts of the run."""

    gauge_words: str  # description of the gauge
    gauge: Table  # content of gauge.ecsv
    matching: Table  # one row per exposure
    stars: Table  # content of stars.ecsv
    outlines: tuple[Float, ...]  # (M, 2), closed, of each chip in each exposure, on the sky


def data_of_selfcal(run: Run) -> SelfcalData:
    """Data of the figures, from the folder of the run."""
    model, theta, epoch, directory = run.model, run.posterior.mean, run.epoch, run.directory
    outlines = []
    for e in range(len(model.exposures)):
        for chip in model.chips:
            x, y = outline_pixels(chip.size)
            when = None if model.time is None else np.full(len(x), epoch)
            codes = np.full(len(x), e)
            outlines.append(
                model.predict(theta, x, y, exposure=codes, chip=chip.number, epoch=when)
            )
    return SelfcalData(
        gauge_words=run.gauge_words,
        gauge=read_ecsv(directory / "gauge.ecsv"),
        matching=read_ecsv(directory / "matching.ecsv"),
        stars=read_ecsv(directory / "stars.ecsv"),
        outlines=tuple(outlines),
    )


REPORT.insert(
    "data",
    PageSection(
        "selfcal",
        "Gauge and stars",
        when=lambda run: isinstance(run.report_data, SelfcalData),
        explained=("self_calibration", ""),
        groups=("Gauge",),
    ),
)


@REPORT.table("selfcal")
def selfcal_tables(run: ReportedRun) -> tuple[TextTable, ...]:
    """Tables of the gauge, the detections, the exposures and the stars."""
    data: SelfcalData = run.report_data
    return (_gauge(data), _detections(run), _exposures(data, run), _stars(run))


def _gauge(data: SelfcalData) -> TextTable:
    rows = [
        {
            "Property": _property(str(row["name"])),
            "From detections": str(row["state"]),
            "σ from these": _sigma(row["sigma_detections"], row["unit"]),
            "σ as fixed": _sigma(row["sigma_fixed"], row["unit"]),
            "at the edge [pix]": _edge(row["sigma_fixed"], row["edge_pix"]),
            "Fixed by": "" if np.ma.is_masked(row["fixed_by"]) else str(row["fixed_by"]),
        }
        for row in data.gauge
    ]
    return tabulated(
        "Degeneracies of the detections, and the constraints that remove them",
        [{key: text or MISSING for key, text in row.items()} for row in rows],
        words=(0, 1, 5),
        note=f"{data.gauge_words} Relative positions do not depend on any of it: their errors are"
        " in the maps of that name.",
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


def _detections(run: ReportedRun) -> TextTable:
    s = run.summary["selfcal"]
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


def _exposures(data: SelfcalData, run: ReportedRun) -> TextTable:
    rows = [
        {
            "Exposure": str(row["exposure"]),
            "Detections": count(row["detections"]),
            "In common": percent(float(row["fraction_common"])),
            "rms on an axis [pix]": number(float(row["rms"])),
            f"Shift u [{run.model.unit}]": number(float(row["shift_u"]), 6),
            f"Shift v [{run.model.unit}]": number(float(row["shift_v"]), 6),
            "Rotation [deg]": number(float(row["rotation"]), 6),
        }
        for row in data.matching[:MAX_ROWS]
    ]
    return tabulated(
        "Exposures",
        rows,
        note="In common: of the detections that lie where another exposure looks. "
        + further(len(data.matching)),
        detail=True,
    )


def _stars(run: ReportedRun) -> TextTable:
    s = run.summary["selfcal"]["stars"]
    mas = scale_mas(run)
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


@REPORT.figure("selfcal")
def selfcal(run: ReportedRun) -> Plot:
    """The field with its exposures, and the errors of the stars."""
    data: SelfcalData = run.report_data
    stars = data.stars[:: max(1, -(-len(data.stars) // MAX_STARS_DRAWN))]
    fig = new_figure(WIDTH, 0.5 * WIDTH)
    field, errors = fig.subplots(1, 2)
    field.plot(stars["u"], stars["v"], ".", ms=1.5, color=PALE, mec="none", zorder=1)
    strong = (0.4, 0.5) if len(data.outlines) > 30 else (0.9, 0.9)
    field.add_collection(
        LineCollection(data.outlines, colors=CYCLE[0], linewidths=strong[0], alpha=strong[1])
    )
    field.set_aspect("equal")
    field.autoscale_view()
    field.set_xlabel(f"u [{run.model.unit}]")
    field.set_ylabel(f"v [{run.model.unit}]")
    field.set_title(f"{count(len(data.matching))} exposures")
    _errors(errors, stars, run.model.unit)
    for ax in (field, errors):
        ax.tick_params(colors=INK)
    s = run.summary["selfcal"]["stars"]
    size = with_mas(ONE_AXIS * s["radius_median"], s["unit"], scale_mas(run))
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
