"""Geometry of a detector as in the handbooks of HST: `bayesdist hst handbook` and `hst pam`.

Numbers are those in the text of section 4.1 of the ACS handbook, not its Table 4.1, with the
published values.  Figures show all chips as one array, like Figures 4.1 to 4.5.  They are oriented
as in pipelines, with x to the right and y upwards; two figures of the ACS handbook are rotated by
180 degrees relative to these.  Pixel area maps are FITS files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from astropy.table import Table
from matplotlib.figure import Figure

from bayesdist.app.commands.inputs import calibration_of_scale, images_of, notes_of
from bayesdist.app.run import Run
from bayesdist.app.screen import number, table_text
from bayesdist.app.store.record import record_folder, refuse_existing, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.calibration.apply import FULL
from bayesdist.calibration.area import PixelAreaMap, pixel_area_map
from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError
from bayesdist.missions.hst.whole_detector import WholeDetector
from bayesdist.model.grid import mesh
from bayesdist.products.maps_file import write_pam
from bayesdist.report.figures.arrows import Arrows, magnification_of, vector_map
from bayesdist.report.figures.fields import Grid, contour_levels, scalar_map
from bayesdist.report.figures.panels import OneArray
from bayesdist.report.figures.style import PALETTE, nice_below
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import size_of

if TYPE_CHECKING:
    from bayesdist.diagnose.residuals.binned import BinnedResiduals

# numbers of vectors, and of points for contours, along the longer side of a chip
_VECTORS, _POINTS = 21, 65

# points per axis of the grid on which extremes are searched for; they occur at edges and corners
_GRID = 129


def handbook(
    path: str | Path,
    output: str | Path,
    *,
    filter: str | None,
    epoch: float | None,
    scale: float | None,
    detector: str | None,
    magnification: float | None,
    command: str,
) -> str:
    """Write the numbers and figures of a calibration to a new folder; returns text to print."""
    # figures take seconds to import
    from bayesdist.report.drawing import save_figures

    if detector is not None:
        detector = acs_detector(detector)
    if magnification is not None and not magnification > 0:
        raise InputError(
            f"the magnification is {magnification}",
            where="--magnification",
            do="give a positive number",
        )
    calibration = calibration_of_scale(path, filter=filter, scale=scale, epoch=epoch)
    pixel, _ = calibration.pixel(epoch)
    if detector is None and calibration.instrument == "ACS":
        detector = calibration.detector
    whole_detector = WholeDetector(calibration.in_frame(epoch), pixel)
    title = _title(calibration, filter, epoch)
    with record_folder(Path(output), "handbook.json", command) as (folder, record):
        figures = {
            "non_linear": non_linear_figure(whole_detector, title, magnification=magnification),
            "pixel_area": area_figure(whole_detector, title),
        }
        binned, missing = _residuals(Path(path))
        if binned:
            figures["residuals"] = residual_figure(whole_detector, binned, calibration.unit, title)
        rows = handbook_rows(
            detector_numbers(whole_detector),
            scale=pixel,
            unit=calibration.unit,
            detector=detector or "",
        )
        save_figures(figures, folder)
        write_table(Table(rows), folder / "numbers.ecsv")
        record |= {"calibration": calibration.name, "detector": detector, "figures": list(figures)}
    shown = [{**row, "published": row["published"] or "-"} for row in rows]
    return f"{output}: {', '.join(figures)}{missing}\n{table_text(shown, 5)}"


def _title(found: Calibration, filter: str | None, epoch: float | None) -> str:
    parts = [Path(found.name).resolve().name, filter or "", f"at {epoch:g}" if epoch else ""]
    instrument = "/".join(p for p in (found.instrument, found.detector) if p)
    return ", ".join(p for p in (instrument, *parts) if p)


def _residuals(path: Path) -> tuple[Mapping[int, BinnedResiduals], str]:
    """Mean residuals in cells by chip number, and a clause that explains their absence."""
    home = path if path.is_dir() else path.parent
    product = path.is_file() and path.suffix != ".nc"  # it may be in another unit
    if product or not (home / "run.json").exists():
        return {}, "; no residuals, since this is not a run"
    try:
        with Run.of(RunDirectory.open(home)) as run:
            chips = run.model.chips
            sums = zip(chips, run.diagnostics.shown, strict=True)
            return {chip.number: chip_sums.residuals() for chip, chip_sums in sums}, ""
    except InputError as error:  # the matches were moved: everything else can be shown
        return {}, f"; no residuals: {error}"


def write_area_maps(
    path: str | Path,
    output: str | Path,
    *,
    chip: int | None,
    filter: str | None,
    epoch: float | None,
    scale: float | None,
    image: str | Path | None,
    force: bool,
) -> str:
    """Write the pixel area maps of a calibration; returns text to print.

    With an image, the maps are made for its subarrays, in the order of its chips.
    """
    output = Path(output)
    if output.suffix.lower() != ".fits":
        raise InputError(
            f"extension {output.suffix!r} is not that of a FITS file",
            where=str(output),
            do="choose a name that ends in .fits",
        )
    refuse_existing(output, force)
    calibration = calibration_of_scale(path, filter=filter, scale=scale, epoch=epoch)
    chips, (pixel, source) = calibration.in_frame(epoch), calibration.pixel(epoch)
    images = images_of(calibration, image=image)
    numbers = list(images or chips)
    if chip is not None:
        if chip not in numbers:
            raise InputError(
                f"there is no chip {chip}",
                where=calibration.name,
                do=f"choose one of {', '.join(map(str, numbers))}",
            )
        numbers = [chip]
    maps = [pixel_area_map(chips[n], pixel, image=images.get(n, FULL)) for n in numbers]
    write_pam(
        output,
        maps,
        instrument=calibration.instrument,
        detector=calibration.detector,
        source=calibration.name,
    )
    notes = "".join(f"; {note}" for note in notes_of(calibration, epoch))
    unit = "pix of u, v" if calibration.unit == "pix" else calibration.unit
    head = (
        f"{output}: pixel area over that of {number(pixel, 6)} {unit} squared "
        f"({source}), by {calibration.name}{notes}"
    )
    return "\n".join([head, *(_line(area_map) for area_map in maps)])


def _line(one: PixelAreaMap) -> str:
    low, high = float(one.area.min()), float(one.area.max())
    text = (
        f"  chip {one.chip}: {low:.5f} to {high:.5f}, "
        f"{-2.5 * np.log10(low):+.4f} to {-2.5 * np.log10(high):+.4f} mag"
    )
    if one.sigma_magnitude is None:
        return text
    return f"{text}, known to {number(1e3 * float(one.sigma_magnitude.max()), 3)} mmag at worst"


def non_linear_figure(
    detector: WholeDetector, title: str = "", *, magnification: float | None = None
) -> Figure:
    """Vector plot of the residuals from the best linear map of the detector, in its pixels.

    `magnification` is the factor by which vectors are enlarged, by default a round number.
    """
    numbers, sizes, chips = detector_numbers(detector), _sizes(detector), []
    for n, size in sizes.items():
        x, y = _grid(size, _VECTORS)
        f = detector.non_linear(n, x, y)
        along = f.along_x.ravel(), f.along_y.ravel()
        chips.append(Arrows(*mesh(x, y), *along, float(x[1] - x[0])))
    step = min(arrows.step for arrows in chips)
    longest = max(float(arrows.length.max()) for arrows in chips)
    M = magnification or (nice_below(2.5 * step / longest) if longest > 1e-9 * step else 1.0)
    panels = OneArray(sizes, detector.places, margin=M * longest + 0.01 * step)
    place = numbers.non_linear_at
    at = f"({place[0]:.0f}, {place[1]:.0f})"
    text = f"largest {numbers.non_linear_max:.3g}\u202foutput pix at {at}"
    text = text.replace("-", "−")
    vector_map(
        panels,
        chips,
        [f"{title}\n{text}" if title else text],
        magnification=M,
        key=nice_below(longest / 1.5),
        pad=11,
    )
    ring: dict[str, Any] = {
        "ms": 6,
        "mfc": "none",
        "mec": PALETTE["vermilion"],
        "mew": 1.3,
        "zorder": 5,
    }
    panels.all_axes[0].plot(*place, "o", **ring)
    return panels.figure


def area_figure(detector: WholeDetector, title: str = "") -> Figure:
    """Contour plot of the pixel area relative to that at the centre of the detector."""
    sizes = _sizes(detector)
    grids = []
    for n, size in sizes.items():
        x, y = _grid(size, _POINTS)
        grids.append(Grid(x, y, detector.relative_area(n, x, y)))
    areas = np.concatenate([g.values.ravel() for g in grids])
    panels = OneArray(sizes, detector.places, colorbar=True)
    text = f"pixel area {areas.min():.3f} to {areas.max():.3f} of that at the centre"
    scalar_map(
        panels,
        grids,
        [f"{title}\n{text}" if title else text],
        levels=contour_levels(areas, 12),
        label="pixel area / area at the centre",
        labelled=True,
    )
    return panels.figure


def residual_figure(
    detector: WholeDetector,
    binned: Mapping[int, BinnedResiduals],
    unit: str,
    title: str = "",
) -> Figure:
    """Vector plot of the mean residuals of a fit in cells of the detector.

    `binned` are the residuals by chip number, along the axes of (u, v).  Cells with a mean within
    two standard errors of zero are drawn in light colour.
    """
    chips = [Arrows.of_cells(b) for b in binned.values()]
    length = np.concatenate([arrows.length for arrows in chips])
    typical = float(np.quantile(length, 0.95)) if length.size else 0.0
    step = min(float(b.x[1] - b.x[0]) for b in binned.values())
    sizes = {n: _sizes(detector)[n] for n in binned}
    panels = OneArray(sizes, detector.places, margin=0.6 * step)
    lines = [
        title,
        "dark: beyond 2 sigma",
        f"95 % of cells below {size_of(typical, unit)}",
    ]
    vector_map(
        panels,
        chips,
        ["\n".join(line for line in lines if line)],
        magnification=magnification_of(1.1 * step, typical),
        key=nice_below(typical),
        unit=unit,
        pad=11,
    )
    return panels.figure


def _sizes(detector: WholeDetector) -> dict[int, tuple[float, float]]:
    return {n: c.basis.size for n, c in detector.chips.items()}


def _grid(size: tuple[float, float], longest: int) -> tuple[Float, Float]:
    """Columns and rows of a grid that includes the corners, with similar spacing on both axes."""
    nx, ny = (max(3, round((longest - 1) * n / max(size)) + 1) for n in size)
    return np.linspace(1.0, size[0], nx), np.linspace(1.0, size[1], ny)


@dataclass(frozen=True)
class DetectorNumbers:
    """Quantities of a detector that are given in section 4.1 of the ACS handbook."""

    non_linear_max: float  # largest non-linear displacement, output pixels
    non_linear_at: tuple[float, float]  # its position, pixels of the detector as one array
    scale_x: float  # pixel scale along the detector's x axis at its centre
    scale_y: float  # pixel scale along the y axis
    mean_scale_x: float  # mean over all pixels of the scale along x
    mean_scale_y: float  # mean over all pixels of the scale along y
    scale_range: float  # ratio of the largest to the smallest scale (root of the area), minus 1
    angle: float  # between the detector's axes at its centre, degrees
    elongation: float  # ratio of the largest to the smallest scale at the centre, minus 1
    area_min: float  # smallest pixel area relative to that at the centre
    area_max: float  # largest pixel area relative to that at the centre
    size: tuple[float, float]  # length of the array along x and y: mean scale times pixels


def detector_numbers(detector: WholeDetector) -> DetectorNumbers:
    """Compute the quantities of section 4.1 of the ACS handbook for any detector."""
    best, position = -1.0, (0.0, 0.0)
    low, high = np.inf, 0.0
    scales, pixels = np.zeros(2), 0.0
    for n, c in detector.chips.items():
        x, y = (np.linspace(1.0, size, _GRID) for size in c.basis.size)
        field = detector.non_linear(n, x, y)
        iy, ix = np.unravel_index(int(field.length.argmax()), field.length.shape)
        if field.length[iy, ix] > best:
            best, position = float(field.length[iy, ix]), (float(field.x[ix]), float(field.y[iy]))
        area = detector.relative_area(n, x, y)
        low, high = min(low, float(area.min())), max(high, float(area.max()))
        slopes = c.slope(*mesh(x, y))
        weight = c.basis.size[0] * c.basis.size[1]
        scales += weight * np.hypot(slopes[:, 0], slopes[:, 1]).mean(axis=0)
        pixels += weight
    L = detector.central_slope
    axes = L[0] + 1j * L[1]
    stretch = np.linalg.svd(L, compute_uv=False)
    mean = scales / pixels
    extent = detector.bounds[1] - detector.bounds[0]
    return DetectorNumbers(
        non_linear_max=best,
        non_linear_at=position,
        scale_x=float(abs(axes[0])),
        scale_y=float(abs(axes[1])),
        mean_scale_x=float(mean[0]),
        mean_scale_y=float(mean[1]),
        scale_range=float(np.sqrt(high / low) - 1.0),
        angle=float(abs(np.degrees(np.angle(axes[1] / axes[0])))),
        elongation=float(stretch[0] / stretch[1] - 1.0),
        area_min=low,
        area_max=high,
        size=(float(mean[0] * extent[0]), float(mean[1] * extent[1])),
    )


# published values by detector and quantity, as printed
_PUBLISHED: dict[str, dict[str, str]] = {
    "WFC": {
        "non-linear": "82",
        "non-linear arcsec": "about 4",
        "angle": "about 85",
        "elongation": "8",
        "area min": "0.89",
        "area max": "1.08",
        "output scale": "0.05",
    },
    "HRC": {
        "non-linear": "4.9",
        "non-linear arcsec": "about 0.1",
        "angle": "about 85",
        "axes": "about 14",
        "scale range": "about 1",
        "area deviation": "just over 2",
        "size x": "29",
        "size y": "25",
        "output scale": "0.025",
    },
    "SBC": {
        "angle": "about 85",
        "size x": "35",
        "size y": "30",
        "output scale": "0.025",
    },
}

# quantities that are published in arcseconds
_ANGLES = ("non-linear arcsec", "size x", "size y", "output scale")


def acs_detector(name: str) -> str:
    """Name of an ACS detector in capitals; raises InputError for any other name."""
    key = name.strip().upper()
    if key not in _PUBLISHED:
        raise InputError(
            f"ACS has no detector {name!r}",
            where="detector",
            do=f"choose one of {', '.join(_PUBLISHED)}",
        )
    return key


class HandbookRow(TypedDict):
    """Row of the table that compares a detector with the published values."""

    quantity: str
    unit: str
    published: str  # text as printed, or empty
    value: float


def handbook_rows(
    numbers: DetectorNumbers, *, scale: float, unit: str, detector: str = ""
) -> list[HandbookRow]:
    """Rows of the table that compares a detector with the published values.

    Parameters
    ----------
    numbers : DetectorNumbers
    scale : float
        Size of an output pixel in `unit`.
    unit : str
        Unit of the undistorted plane.
    detector : str
        WFC, HRC or SBC of ACS; for other detectors there are no published values.

    Returns
    -------
    list of HandbookRow
        Rows in the order of the handbook.
    """
    n = numbers
    angle = unit if unit != "pix" else "pix of u, v"
    scales = f"{angle}/pix"
    deviation = 100 * max(1 - n.area_min, n.area_max - 1)
    axes = 100 * (max(n.scale_x, n.scale_y) / min(n.scale_x, n.scale_y) - 1)
    listed = [
        ("non-linear", "largest non-linear displacement", "output pix", n.non_linear_max),
        (f"non-linear {unit}", f"the same in {angle}", angle, n.non_linear_max * scale),
        ("", "where: x", "pix", n.non_linear_at[0]),
        ("", "where: y", "pix", n.non_linear_at[1]),
        ("angle", "angle between the axes at the centre", "deg", n.angle),
        ("elongation", "elongation at the centre", "%", 100 * n.elongation),
        ("", "scale along x at the centre", scales, n.scale_x),
        ("", "scale along y at the centre", scales, n.scale_y),
        ("axes", "difference of these scales", "%", axes),
        ("", "mean scale along x", scales, n.mean_scale_x),
        ("", "mean scale along y", scales, n.mean_scale_y),
        ("scale range", "range of the scale, root of area", "%", 100 * n.scale_range),
        ("area min", "smallest pixel area, centre 1", "", n.area_min),
        ("area max", "largest pixel area, centre 1", "", n.area_max),
        ("area deviation", "largest deviation of the area", "%", deviation),
        ("size x", "length along x", angle, n.size[0]),
        ("size y", "length along y", angle, n.size[1]),
        ("output scale", "size of an output pixel", angle, scale),
    ]
    published = _PUBLISHED.get(detector.strip().upper(), {})
    if unit != "arcsec":
        published = {key: text for key, text in published.items() if key not in _ANGLES}
    return [
        {
            "quantity": quantity,
            "unit": row_unit,
            "published": published.get(key, ""),
            "value": float(value),
        }
        for key, quantity, row_unit, value in listed
    ]
