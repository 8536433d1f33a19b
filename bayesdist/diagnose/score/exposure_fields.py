"""Test for smooth fields that differ from exposure to exposure, from products of nearby stars.

The sum of products within exposures, minus that across exposures, is weighted according to the
signal of a field with a given correlation length.  It is a quadratic form of independent scores, so
that its distribution is approximated by a chi-square with the same skewness.  A few correlation
lengths are tried.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.diagnose.correlated.exposure_products import (
    DetectionScores,
    ExposureProducts,
    exposure_products,
    modes,
)
from bayesdist.diagnose.score.result import POWER, Family, Outcome, outcome
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.utils.distributions import chi2_isf, chi2_sf

EXPOSURE_FIELDS = Family(
    "fields of exposures",
    "calibrate exposures one by one, or take more of them, in whose mean such fields average out",
    "exposures differ by a smooth field that is new in each",
    "exposures do not differ by smooth fields",
    held_by="exposure fields",
)
LENGTHS = (0.08, 0.2, 0.5)  # correlation lengths that are tried, in longer half sides


def exposure_field_test(sample: ScoredSample) -> Outcome | None:
    """Test for fields of single exposures; None if fewer than two exposures have enough stars."""
    if len({block.exposure for block in sample.blocks}) < 2:
        return None
    scores = DetectionScores(
        sample.X, sample.Y, *sample.on_detector, sample.chip, sample.exposure, sample.star
    )
    chips = exposure_products(scores, [chip.size for chip in sample.model.chips])
    if not chips:
        return None
    tried = [_tried(list(chips.values()), length) for length in LENGTHS]
    p, statistic, dof, variance, error, length = min(tried)
    # both axes together, without terms up to second order; the contribution of noise is subtracted
    remaining = 2 * modes(next(iter(chips.values())).size, length).left
    size = np.sqrt(remaining * max(variance, 0.0))

    def smallest(level: float) -> float:
        limit = _deviate(level / len(LENGTHS), dof)
        return float(np.sqrt(remaining * error * max(limit - _deviate(POWER, dof), 0.0)))

    half = max(max(chip.size) for chip in sample.model.chips) / 2
    family = EXPOSURE_FIELDS
    present = f"{family.present}, over some {length * half:.2g} pix"
    return outcome(
        replace(family, present=present),
        statistic,
        dof,
        None,
        min(1.0, len(LENGTHS) * p),
        square=size**2,
        noise=0.0,
        unit=sample.model.unit,
        smallest=smallest,
    )


def _tried(
    chips: list[ExposureProducts], length: float
) -> tuple[float, float, float, float, float, float]:
    """Probability, chi-square, its degrees of freedom, variance of the field, its error, length."""
    fits = np.array([chip.amplitude(length) for chip in chips])
    weight = fits[:, 1] ** -2
    variance, error = float(fits[:, 0] @ weight / weight.sum()), float(weight.sum() ** -0.5)
    dof = sum(chip.n_fields * modes(chip.size, length).dof for chip in chips)
    T = max(dof + variance / error * np.sqrt(2 * dof), 0.0)
    return float(chi2_sf(T, dof)), T, dof, variance, error, length


def _deviate(level: float, dof: float) -> float:
    """Standardised chi-square that is exceeded with the probability `level`."""
    return float((chi2_isf(level, dof) - dof) / np.sqrt(2 * dof))
