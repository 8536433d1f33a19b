"""All figures of a comparison of bands, by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesdist.report.bands.context import BandResult, BandsInput
from bayesdist.report.bands.curves import correlation_curves, histograms
from bayesdist.report.bands.panels import band_images
from bayesdist.report.bands.vectors import band_crosses, band_flows

if TYPE_CHECKING:
    from bayesdist.assess.wise.rows import BinValues

__all__ = ["DIFFERENCE", "FLOW", "OPTICAL", "band_figures"]

Float = NDArray[np.float64]

# magnifications in section 4 of WSDC D-T033
FLOW, DIFFERENCE, OPTICAL = 10.0, 50.0, 20.0
AXES = ("X", "Y")


def band_figures(inputs: BandsInput) -> dict[str, Figure]:
    """Every figure that the results allow, in the order of the page.

    Parameters
    ----------
    inputs : BandsInput

    Returns
    -------
    dict of str to matplotlib.figure.Figure
        Names serve as file names.
    """
    bands, several = inputs.bands, len(inputs.bands) > 1
    arcsec = {b.name: b.arcsec for b in bands}
    first = bands[0]
    out = {
        "vectors": band_flows(
            {b.name: b.vectors for b in bands}, arcsec, magnification=_as_printed(inputs, FLOW)
        )
    }
    if several:
        out["differences"] = band_flows(
            inputs.differences,
            dict.fromkeys(inputs.differences, first.arcsec),
            magnification=_as_printed(inputs, DIFFERENCE),
        )
    less = {f"{b.name} − optical": b.minus_optical for b in bands if b.minus_optical is not None}
    if less:
        out["minus_optical"] = band_flows(
            less,
            {f"{b.name} − optical": b.arcsec for b in bands},
            magnification=_as_printed(inputs, OPTICAL),
        )
    out["histograms"] = histograms({b.name: b.sums.histograms for b in bands})
    for axis in AXES:
        out[f"residuals_{axis.lower()}"] = _residual_images(bands, axis)
    if several:
        for axis in AXES:
            out[f"alignment_{axis.lower()}"] = _alignment_images(bands, axis)
    out["correlation"] = correlation_curves(bands)
    out["formal_uncertainty"] = band_crosses({b.name: b.formal_map for b in bands})
    out["coverage"] = _coverage(bands)
    return out


def _as_printed(inputs: BandsInput, magnification: float) -> float | None:
    """That of the WISE report, for its bands; else one that fits the vectors."""
    return magnification if inputs.wise else None


def _residual_images(bands: tuple[BandResult, ...], axis: str) -> Figure:
    values = {b.name: b.sums.bins.values(axis) for b in bands}
    return _images(values, {b.name: b.size for b in bands}, axis, "pix")


def _alignment_images(bands: tuple[BandResult, ...], axis: str) -> Figure:
    values, sizes = {}, {}
    for k, earlier in enumerate(bands):
        for later in bands[k + 1 :]:
            name = f"{later.name}−{earlier.name}"
            one, two = (b.sums.bins.values(axis).scaled(b.arcsec) for b in (later, earlier))
            values[name], sizes[name] = one.minus(two), earlier.size
    return _images(values, sizes, axis, "arcsec", alone=True)


def _images(
    values: Mapping[str, BinValues],
    sizes: Mapping[str, tuple[float, float]],
    axis: str,
    unit: str,
    alone: bool = False,
) -> Figure:
    images = {name: v.mean for name, v in values.items()}
    titles = {
        name: f"{name} {axis}: {_signed(np.nanmin(image))} to {_signed(np.nanmax(image))}"
        for name, image in images.items()
    }
    label = f"mean residual in {axis} [{unit}]"
    return band_images(images, sizes, titles, label=label, limit=_limit, alone=alone)


def _signed(value: float) -> str:
    return f"{value:+.3f}".replace("-", "−")


def _limit(images: Collection[Float], centre: float = 0.0) -> float:
    """Largest value of all but one bin in two hundred."""
    every = np.concatenate([np.abs(i - centre)[np.isfinite(i)] for i in images])
    return max(float(np.quantile(every, 0.995)), 1e-12)


def _coverage(bands: tuple[BandResult, ...]) -> Figure:
    images, titles = {}, {}
    for b in bands:
        count = b.sums.bins.axes.count
        expected = float(count.mean())
        images[b.name] = count / expected
        titles[b.name] = (
            f"{b.name}: {expected:.0f} ± {np.sqrt(expected):.0f} expected,\n"
            f"{count.min()} to {count.max()} found"
        )
    return band_images(
        images,
        {b.name: b.size for b in bands},
        titles,
        label="pairs over those of even coverage",
        limit=partial(_limit, centre=1.0),
        centre=1.0,
    )
