"""The words under each figure of a comparison of bands."""

from __future__ import annotations

from bayesdist.report.bands.context import BandsInput
from bayesdist.report.caption import Caption

__all__ = ["SECTIONS", "caption"]

SECTIONS = {
    "vectors": ("vectors", "differences", "minus_optical"),
    "histograms": ("histograms",),
    "tables": (),
    "structure": ("residuals_x", "residuals_y", "correlation", "alignment_x", "alignment_y"),
    "formal": ("formal_uncertainty",),
    "coverage": ("coverage",),
}


def caption(name: str, inputs: BandsInput) -> Caption:
    """Words of one of the figures in `SECTIONS`."""
    if name.startswith(("residuals_", "alignment_")):
        return _image(name, inputs)
    return _WRITERS[name](inputs)


def _vectors(inputs: BandsInput) -> Caption:
    return Caption(
        "Distortion",
        "From each place of the array towards where its light comes from, the constant suppressed."
        " All bands are drawn to one scale in arcsec; the ring marks the longest vector.",
        "Maps of arrows over the array of each band, longest in the corners.",
    )


def _differences(inputs: BandsInput) -> Caption:
    first = inputs.names[0]
    return Caption(
        "Differences of bands",
        f"Later bands minus {first} at the same place of the field, in pixels of {first},"
        " constants suppressed.",
        "Maps of arrows: how the distortion of each band differs from that of the first.",
    )


def _minus_optical(inputs: BandsInput) -> Caption:
    return Caption(
        "Bands minus the optical model",
        f"In pixels of each band, constants suppressed. Optical model: {inputs.optical}.",
        "Maps of arrows: what the optical model leaves of each band's distortion.",
    )


def _histograms(inputs: BandsInput) -> Caption:
    cases = "Without correction (blue)"
    if inputs.optical:
        cases += ", corrected by the optical model (green, dashed)"
    return Caption(
        "Residuals of all pairs",
        f"{cases} and by this calibration (red); counts are logarithmic. In all cases the constant"
        " is the calibrated one. What is alike in all, far from zero, are false matches.",
        "Histograms of the residuals in X and Y for each band: calibration makes a narrow peak.",
    )


def _image(name: str, inputs: BandsInput) -> Caption:
    what, _, axis = name.partition("_")
    axis = axis.upper()
    n = f"{inputs.n_bins} × {inputs.n_bins} bins"
    if what == "residuals":
        return Caption(
            f"Mean residuals in {axis}",
            f"Of the pairs used, in {n}; one colour scale for all bands, symmetric about zero."
            " Titles give the extremes. Blocks with sharp edges are no distortion.",
            f"Images of the mean residual in {axis} over the array of each band.",
        )
    return Caption(
        f"Mean residuals in {axis} of two bands, one minus the other",
        f"In arcsec, in {n}: by how much two bands observed together are misaligned. Each panel has"
        " its own colour scale.",
        f"Images of differences of mean residuals in {axis} for each pair of bands.",
    )


def _correlation(inputs: BandsInput) -> Caption:
    return Caption(
        "Correlation of mean residuals",
        "Mean product of the residuals of two bins by their separation; what noise makes of it is"
        " subtracted. Points beyond the shaded bands are structure that the polynomial leaves.",
        "Curves of the correlation of residuals against separation for each band.",
    )


def _formal(inputs: BandsInput) -> Caption:
    return Caption(
        "Formal uncertainty",
        "Least squares: four vectors from each place to all combinations of ±1 σ in x and in y."
        " Each panel states its magnification, 2000 or what shows the vectors.",
        "Maps of small crosses over the array of each band, largest in the corners.",
    )


def _coverage(inputs: BandsInput) -> Caption:
    return Caption(
        "Coverage by pairs",
        "Pairs used in each bin over the mean of all bins. Titles give that mean with the Poisson"
        " error of one bin, and the fewest and most found.",
        "Images of the number of pairs over the array of each band.",
    )


_WRITERS = {
    "vectors": _vectors,
    "differences": _differences,
    "minus_optical": _minus_optical,
    "histograms": _histograms,
    "correlation": _correlation,
    "formal_uncertainty": _formal,
    "coverage": _coverage,
}
