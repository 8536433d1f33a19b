"""Questions to the detections: functions that a model may lack, each with its words.

This is the list for matched stars, campaigns and self-calibrations. How parameters and stars are
projected out of the functions, the statistic, its p-value and the smallest effect that would have
been found follow from them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayesdist.diagnose.score.result import LOOK_UP_TABLE, Family
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.model.basis import MAX_ORDER, polynomial_terms
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Float

Terms = tuple[tuple[int, int], ...]

CONSTANT, LINEAR = polynomial_terms(0), polynomial_terms(1)
HIGHER = 2  # orders above the model's that are tested
OUTSIDE = 0.5  # per cent of the values at either end that are moved to the others
MIN_AT_EDGES = 200  # detections: some in each margin
MIN_OF_PHASES = 200  # detections: some at each phase of a pixel
FEWEST_DIGITS = 5  # decimals of a pixel, from which on digits that are missing displace nothing
WHOLE = 1e-6  # of the last digit, by which a number with few digits differs from its rounded value
# fractions of the detections: those with few digits, and the others, are at least so many
MIN_CUT_OFF = 0.05
BY_CHANCE = 0.3  # most that end in 0 by chance, of those with one digit more; a tenth on average
NEAR_EDGE = 0.05  # of half a side, over which what is at an edge falls off
SHORTEST = 0.1  # years over which a drift is looked for
# of the information of a direction, left by the parameters: below, it is theirs
INDEPENDENT = 1e-6
OWN_OF_TIME = 0.02  # frames take up drifts but for what the curvature of the polynomial leaves


@dataclass(frozen=True, eq=False)
class Products:
    """Functions of the detections: polynomial terms times a number of each detection.

    Each moves both axes of each chip freely, or only along a given direction.
    """

    terms: Terms  # powers (i, j) of Legendre polynomials over the chip
    values: Float | None = None  # (N,) that multiply the terms; 1 by default
    # (2,) or (2, N) displacement along the axes of the detector; those of the sky are turned by
    # `ScoredSample.along_detector`
    direction: Float | None = None


@dataclass(frozen=True, eq=False)
class Question:
    """What a model may lack: functions of the detections that are tested together."""

    family: Family
    products: tuple[Products, ...]
    # fraction of its information that a direction must keep when parameters are projected out
    least: float = INDEPENDENT
    # group of families that are fitted as well in a second test, which counts where it sees nothing
    adjusted_for: str = ""


MAGNITUDE = Family(
    "magnitude",
    "cut the faint stars, or correct the charge-transfer efficiency",
    "the residuals go with the magnitude of the stars",
    "the residuals do not go with the magnitude of the stars",
)
COLOUR = Family(
    "colour",
    "select a narrower range of colours, or calibrate ranges of colours one by one",
    "the residuals go with the colour of the stars",
    "the residuals do not go with the colour of the stars",
)
POINTING = Family(
    "pointing",
    "give the true detector.scale_mas, by which tangent planes are taken to one",
    "the distortion goes with where exposures point, as if a curved sky were taken as flat",
    "the distortion does not go with where exposures point",
)
EDGES = Family(
    "edges",
    f"leave out the margins of the detector, or {LOOK_UP_TABLE}",
    "the residuals rise towards the edges of the detector",
    "the residuals do not rise towards the edges of the detector",
)
PIXEL_PHASE = Family(
    "pixel phase",
    "correct the centroids for it, as an effective point-spread function does",
    "the residuals go with the position of the stars within their pixel",
    "the residuals do not go with the position of the stars within their pixel",
)
CUT_OFF = Family(
    "cut-off positions",
    "give all positions with all of their digits, or add half a step to those that were cut off",
    "stars whose positions have few digits are displaced from the others",
    "stars whose positions have few digits are not displaced from the others",
)
MAGNITUDE_IN_TIME = Family(
    "magnitude in time",
    "cut the faint stars, correct the charge-transfer efficiency, or leave out the late years",
    "how the residuals go with the magnitude of the stars changes with time",
    "how the residuals go with the magnitude of the stars does not change with time",
)
DRIFT = Family(
    "drift",
    "add time-dependent terms to model.tdd",
    "linear terms drift with time, and the model's do not",
    "no drift of the linear terms is left in the residuals",
    explained_by="exposures",
)
CURVATURE = Family(
    "curvature in time",
    "give model.tdd a break, or shorter periods",
    "the time dependence is not linear",
    "no curvature of the time dependence is left in the residuals",
    held_by="curvature",
    explained_by="exposures",
)


def order_family(total: int, order: int) -> Family:
    """Words of the test for terms of one total order, of a model that ends at another."""
    return Family(
        f"order {total}",
        f"raise model.order to {total}" if total <= MAX_ORDER else LOOK_UP_TABLE,
        f"the residuals hold terms of order {total}, and the model ends at order {order}",
        f"no terms of order {total} are left in the residuals",
        group="orders",
        held_by="structure",
        denial="the missing order does not explain it",
    )


def questions(sample: ScoredSample) -> Iterator[Question]:
    """Iterator over what a sample can be asked; values that do not vary are left out later."""
    order = sample.model.order
    for total in range(order + 1, order + HIGHER + 1):
        terms = polynomial_terms(total)[len(polynomial_terms(total - 1)) :]
        yield Question(order_family(total, order), (Products(terms),))
    if sample.mag is not None:
        yield Question(MAGNITUDE, (Products(LINEAR, _standing_out(sample.mag)),))
    if sample.offset is not None and sample.position is not None:
        # to first order, what a curved sky makes of the tangent planes of exposures
        p, q = sample.position
        values = [square * along for square in (p * p, p * q, q * q) for along in sample.offset]
        yield Question(POINTING, tuple(Products(CONSTANT, one) for one in values))
    if not sample.has_catalogue:
        return  # how often the others err where stars are solved for is not known
    if sample.colour is not None:
        yield Question(COLOUR, (Products(LINEAR, _standing_out(sample.colour)),))
    if len(sample) >= MIN_AT_EDGES:
        rising = [np.exp((s * Z - 1.0) / NEAR_EDGE) for Z in (sample.X, sample.Y) for s in (-1, 1)]
        edges = tuple(Products(CONSTANT, one - one.mean()) for one in rising)
        # a missing order rises towards the edges as well
        yield Question(EDGES, edges, adjusted_for="orders")
    if len(sample) >= MIN_OF_PHASES:
        yield Question(PIXEL_PHASE, tuple(Products(CONSTANT, wave) for wave in _phases(sample)))
    if cut_off := tuple(Products(CONSTANT, few - few.mean()) for few in _few_digits(sample)):
        yield Question(CUT_OFF, cut_off)
    yield from _of_time(sample)


def _from_edge(sample: ScoredSample) -> Float:
    """Distance (2, N) of each detection from the edge of the first column and row, in pixels."""
    size = np.array([chip.size for chip in sample.model.chips])[sample.chip]
    return np.stack([sample.X + 1.0, sample.Y + 1.0]) / 2 * size.T


def _few_digits(sample: ScoredSample) -> Iterator[Float]:
    """Indicators (N,) of the detections whose columns, or rows, have fewer digits than others.

    There is at most one for each axis: none if all have the same number of digits.
    """
    for distance in _from_edge(sample):
        few = []
        for digits in range(FEWEST_DIGITS + 1):
            shifted = (distance + 0.5) * 10.0**digits
            few.append(np.abs(shifted - np.round(shifted)) < WHOLE)
        for fewer, more in pairwise(few):
            share = fewer.mean()
            if MIN_CUT_OFF <= share <= 1 - MIN_CUT_OFF and share > BY_CHANCE * more.mean():
                yield fewer.astype(float)
                break


def _phases(sample: ScoredSample) -> Iterator[Float]:
    """Sine and cosine (N,) of the phase of each detection along the columns and rows of pixels.

    A wave of one pixel is too short for the test of repeating patterns, and looks like noise.
    """
    for distance in _from_edge(sample):
        phase = 2 * np.pi * distance
        for wave in (np.sin(phase), np.cos(phase)):
            yield wave - wave.mean()


def _of_time(sample: ScoredSample) -> Iterator[Question]:
    """Questions to detections of several dates."""
    time, epoch = sample.model.time, sample.epoch
    if epoch is None or np.ptp(epoch) <= SHORTEST:
        return
    half = (2 * epoch - epoch.min() - epoch.max()) / np.ptp(epoch)  # from -1 to 1
    if sample.mag is not None:
        values = _standing_out(sample.mag) * half
        yield Question(MAGNITUDE_IN_TIME, (Products(LINEAR, values),))
    yield Question(DRIFT, (Products(LINEAR, half - half.mean()),), OWN_OF_TIME)
    if time is not None and len(np.unique(epoch)) > 2:
        order = max([1, *(i + j for _, i, j in time.terms)])
        products = Products(polynomial_terms(order), _beyond_lines(half, time, epoch))
        yield Question(CURVATURE, (products,), OWN_OF_TIME)


def _standing_out(values: Float) -> Float:
    """Values about their mean; codes for what is missing are brought to the others."""
    low, high = np.percentile(values, [OUTSIDE, 100 - OUTSIDE])
    inside = np.clip(values, low, high)
    return np.asarray(inside - inside.mean())


def _beyond_lines(half: Float, time: TimeDependence, epoch: Float) -> Float:
    """Square of time, without what a constant and the segments' own lines say of it."""
    design = np.column_stack([np.ones(len(half)), time.weights(epoch)])
    dates, of = np.unique(half, return_inverse=True)
    first = np.unique(of, return_index=True)[1]
    weight = np.sqrt(np.bincount(of))
    found = np.linalg.lstsq(weight[:, None] * design[first], weight * dates**2)[0]
    return half**2 - design @ found
