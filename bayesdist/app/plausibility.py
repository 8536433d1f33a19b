"""Checks of stars, dates and errors: refusal of impossible values, warnings of unusual ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.polynomial import legendre

from bayesdist.app.config import Config
from bayesdist.app.kind import doubts_on_numbers
from bayesdist.app.run import Run
from bayesdist.data import Matches
from bayesdist.data.tables.checks import ZERO_MOTION
from bayesdist.data.tables.names import NO_MOTION
from bayesdist.data.tangent import sky_of_plane
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel, TimeDependence
from bayesdist.model.basis import MAX_ORDER, n_terms, polynomial_terms
from bayesdist.utils.arrays import Bool, Float, Int

OFF = 1e3  # factor on the expected scale beyond which u and v are refused
ODD = 3.0  # factor on the expected scale beyond which there is a warning
SMALLEST_ERROR = 1e-6  # pixels: smaller errors are impossible
FEWEST = 10  # fewest stars that determine a scale
HALF_TURN = 180.0  # degrees: largest plausible extent of u and v
IN_DEGREES = {"deg": 1.0, "arcsec": 1 / 3600, "mas": 1 / 3.6e6}
# Positions that were computed from pixels scatter less than these sizes, in pixels.  Decimals of a
# table are a part of the scatter: 7 of a right ascension in degrees are 0.001 px of 0.1 arcsec.
MADE_FROM_PIXELS = 1e-3
ROUNDED_POSITIONS = 1e-2  # only if errors are quoted, with a warning
CERTAINLY_MADE = 1e-4  # if no errors are quoted
FAR_BELOW = 0.1  # and less than this fraction of the quoted errors
# ratios of the scatter to the rounding of a table between which the rounding explains it: 1.0 to
# 1.3 for the robust scatter of rounded numbers, widened for few stars
LIKE_ROUNDING = (0.75, 1.5)
MOST_DECIMALS = 9  # of a table; with more, rounding is not seen
NEARLY_WHOLE = 1e-3  # largest deviation from a whole number of units of the last decimal
SAME_SCATTER = 0.03  # relative difference below which a given error is the scatter itself
ORDER = 4
OTHER_ORDERS = (1, 2, 9)  # orders for few stars, and for headers of high order
STARS_OF_OTHER_ORDERS = 600  # to which these are fitted
# rounds of rejection in estimates of the scatter, and in comparisons of orders
ROUNDS, ORDER_ROUNDS = 20, 6
NORMAL = 1.4826022185056018  # 1 / (median of |z|, z standard normal)
CLIP = 4.0  # robust standard deviations
EACH = 4  # fewest stars per coefficient
NOISE_FREE = 1e-8  # pixels: smaller scatter is rounding, not measurement
ON_A_LINE = 1e-6  # largest extent of positions across a line, relative to that along it
LOW_ORDER = 1.7  # ratio of scatters about two orders above which the lower order is too low
BEST_ORDER = 1.2  # ratio of scatters below which two orders are equally good
IN_PEAK = 0.4  # part of the residuals: fewer than those of the larger of two groups of stars
MOST_STARS = 1500  # used to compare orders
USE_WITHOUT_MOTION = (
    "to use them, set data.sigma to 'columns' and name columns with the errors of positions and "
    "motions, and give data.motion_prior if fewer than 30 stars have a motion"
)
YEARS = (1950.0, 2100.0)


def doubts_on_stars(stars: Matches, model: DistortionModel, config: Config) -> list[str]:
    """Sentences about unusual properties of matched stars (all or a sample, in memory)."""
    doubts = list(_doubts(stars, model, config.detector.scale_mas))
    if config.catalogue is not None and model.unit in IN_DEGREES:
        apart = IN_DEGREES[model.unit] * _distance_of_exposures(stars)
        doubt = config.catalogue.catalogue().doubt_on_pointings(apart)
        doubts += [doubt] if doubt else []
    return [*doubts, *_doubts_on_order(stars, model.order)]


def left_out(stars: Matches) -> Iterator[str]:
    """Number of rows that were left out in reading, for each reason, and how to use them."""
    for reason, count in stars.rejected.items():
        remedy = f"; {USE_WITHOUT_MOTION}" if reason in (NO_MOTION, ZERO_MOTION) else ""
        yield f"{count} rows: {reason}{remedy}"


def doubts_on_run(run: Run) -> list[str]:
    """Sentences about unusual properties of the matched stars of a run."""
    return doubts_on_stars(_with_quoted_errors(run), run.model, run.config)


def doubt_on_positions(run: Run) -> str:
    """Sentence about positions that were probably computed from the pixels; empty if none were."""
    stars = _with_quoted_errors(run)
    scale = _scale(stars)
    if len(stars) < FEWEST or scale is None:
        return ""
    return next(_doubts_on_scatter(stars, scale), "")


def _with_quoted_errors(run: Run) -> Matches:
    """Sample of the stars of a run without errors by magnitude, which their scatter determines."""
    if run.errors.by_magnitude is None:
        return run.sample
    return run.sample.without("sigma_u", "sigma_v", "rho_uv")


def _distance_of_exposures(stars: Matches) -> float:
    """Largest distance of the mean position of an exposure's stars from that of all, in u and v."""
    if stars.exposure is None:
        return 0.0
    n = np.maximum(np.bincount(stars.exposure), 1)
    middle = np.stack([np.bincount(stars.exposure, a) / n for a in (stars.u, stars.v)])
    middle = middle[:, np.bincount(stars.exposure) > 0]
    return float(np.hypot(*(middle - middle.mean(axis=1, keepdims=True))).max())


def refuse_stars(stars: Matches, model: DistortionModel, config: Config) -> None:
    """Raise InputError for matched stars with impossible values; see `doubts_on_stars`."""
    for _ in _doubts(stars, model, config.detector.scale_mas):
        pass


def _doubts(stars: Matches, model: DistortionModel, scale_mas: float | None) -> Iterator[str]:
    unit = model.unit
    if stars.epoch is not None:
        yield from _doubts_on_dates(stars.epoch, ", ".join(stars.sources))
    yield from doubts_on_numbers(stars, model)
    scale = _scale(stars)
    if len(stars) < FEWEST or scale is None:
        return
    yield from _doubts_on_scale(stars, scale, unit, scale_mas)
    yield from _doubts_on_errors(stars, scale)
    yield from _doubts_on_scatter(stars, scale)


def _scale(stars: Matches) -> float | None:
    """Units of u and v per pixel, from the spread of both on each chip; None if stars coincide."""
    pixels = float(np.hypot(_spread(stars, stars.x), _spread(stars, stars.y)))
    plane = float(np.hypot(_spread(stars, stars.u), _spread(stars, stars.v)))
    return plane / pixels if pixels > 0 and plane > 0 else None


def _spread(stars: Matches, values: Float) -> float:
    """Standard deviation about the mean of each chip in each exposure.

    Chips are side by side in u and v, and so are exposures with different pointings.
    """
    code = stars.chip
    if stars.exposure is not None:
        code = code + (int(code.max()) + 1) * stars.exposure
    n = np.maximum(np.bincount(code), 1)
    return float(np.std(values - (np.bincount(code, values) / n)[code]))


def _doubts_on_scale(
    stars: Matches, scale: float, unit: str, scale_mas: float | None
) -> Iterator[str]:
    files = ", ".join(stars.sources)
    if unit in IN_DEGREES:
        reach = float(max(np.ptp(stars.u), np.ptp(stars.v))) * IN_DEGREES[unit]
        if reach > HALF_TURN and stars.tangent_point is not None:
            width = 2 * np.degrees(np.arctan(np.radians(reach / 2)))
            raise InputError(
                f"the field is some {width:.0f} degrees wide, and on the tangent plane of ra and "
                f"dec it would span {reach:.4g} degrees, which no polynomial follows",
                where=files,
                do="fit the field in parts, each with data.tangent_point at its centre, or give u "
                "and v of a projection for wide fields, such as ARC or ZEA; check ra and dec if "
                "the field is narrower",
            )
        if reach > HALF_TURN:
            raise InputError(
                f"u and v span {reach:.4g} degrees if they are in {unit}",
                where=files,
                do="correct data.unit, or the unit in the table: they may be pixels",
            )
    expected = 1.0
    if unit != "pix":
        if scale_mas is None:
            return
        expected = scale_mas / 3.6e6 / IN_DEGREES[unit]
    factor = scale / expected
    by = "pixels" if unit == "pix" else f"pixels and detector.scale_mas = {scale_mas:g}"
    fault = f"u and v, in {unit}, span {factor:.3g} times what {by} say"
    if not 1 / OFF < factor < OFF:
        raise InputError(fault, where=files, do="correct data.unit, the scale or the columns")
    if not 1 / ODD < factor < ODD:
        yield f"{fault}: check data.unit and the scale"


def _doubts_on_errors(stars: Matches, scale: float) -> Iterator[str]:
    if not stars.has_sigma:
        return
    sigma = np.minimum(stars.column("sigma_u"), stars.column("sigma_v")) / scale
    middle, smallest = float(np.median(sigma)), float(sigma.min())
    if middle < SMALLEST_ERROR:
        raise InputError(
            f"half of the errors are below {middle:.2g} px, which no detector reaches",
            where=", ".join(stars.sources),
            do="check the unit of the columns of errors, or data.sigma",
        )
    if smallest < SMALLEST_ERROR:
        yield f"the smallest of the quoted errors is {smallest:.2g} px: check such rows"


def _doubts_on_scatter(stars: Matches, scale: float) -> Iterator[str]:
    """Sentence about reference positions that may be a function of the pixels.

    Raises InputError if they are: if their scatter is far below the quoted errors or, without
    quoted errors, below that of any detector.
    """
    scatter = _smallest_scatter(stars)
    if scatter is None or _on_a_line(stars):  # the fit refuses stars on a line
        return
    in_pixels = float(f"{scatter / scale:.2g}")
    certain, doubtful = CERTAINLY_MADE, MADE_FROM_PIXELS
    quoted = _quotes_errors(stars)
    rounding = "" if quoted else _rounding_like(stars, scatter)
    if quoted:
        sigma = np.minimum(stars.column("sigma_u"), stars.column("sigma_v"))
        far_below = FAR_BELOW * float(np.median(sigma)) / scale
        certain = max(NOISE_FREE, min(MADE_FROM_PIXELS, far_below))
        doubtful = min(ROUNDED_POSITIONS, far_below)
    follow = f"the reference positions follow a polynomial of the pixels to {in_pixels:.1g} px"
    if in_pixels < certain:
        raise InputError(
            f"{follow}, which no detector reaches: they were computed from the pixels by a WCS, or "
            "are those of a design, and without the noise of measured positions there are no "
            "errors to find",
            where=", ".join(stars.sources),
            do="match the detections with a catalogue; the WCS of the image becomes a header of "
            "another form by 'bayesdist convert IMAGE.fits --to sip' (with --sample if it has no "
            "distortion or another projection), and a design a calibration without errors by "
            "bayesdist.fit_linear in Python",
        )
    if in_pixels < doubtful:
        yield (
            f"{follow}, far better than detectors measure{rounding and f', and {rounding}'}: they "
            "were probably computed from the pixels by a WCS, and a fit only gives back that WCS; "
            "match the detections with a catalogue"
        )
    elif rounding:
        yield (
            f"{follow}, and {rounding}: no noise of a measurement is seen, so that they may have "
            "been computed from the pixels by a WCS, and a fit would only give back that WCS; "
            "match the detections with a catalogue or, if the positions were measured, write the "
            "table with more decimals or state their errors"
        )


def _quotes_errors(stars: Matches) -> bool:
    """True if stars have errors other than their scatter about a polynomial, drafted by `init`."""
    if not stars.has_sigma:
        return False
    sigma = np.concatenate([stars.column("sigma_u"), stars.column("sigma_v")])
    scatter = scatter_about_polynomials(stars)
    is_scatter = scatter is not None and abs(scatter - sigma[0]) <= SAME_SCATTER * sigma[0]
    return not (is_scatter and np.ptp(sigma) == 0)


def _rounding_like(stars: Matches, scatter: float) -> str:
    """Clause on decimals of the table that explain the scatter; empty if they do not.

    `scatter` is in the unit of u and v.  Positions on the sky have the decimals of right ascension
    and declination, unless proper motions have moved them.
    """
    plane, names = (stars.u, stars.v), ("u", "v")
    unit, stretch = 1.0, np.ones(2)
    if stars.tangent_point is not None and stars.unit in IN_DEGREES:
        unit = IN_DEGREES[stars.unit]
        xi, eta = (3600 * unit * z for z in plane)
        plane = sky_of_plane(xi, eta, stars.tangent_point)
        names, stretch = ("ra", "dec"), np.array([np.cos(np.radians(stars.tangent_point[1])), 1])
    pixels = [_decimals(z) for z in (stars.x, stars.y)]
    decimals = [_decimals(z) for z in plane]
    step = _step(pixels) * (_scale(stars) or 1.0)
    steps = np.array([_step([n]) for n in decimals]) * stretch / unit
    rounding = float(np.hypot(step, steps.max()) / np.sqrt(12))
    if not rounding or not LIKE_ROUNDING[0] <= scatter / rounding <= LIKE_ROUNDING[1]:
        return ""
    words = [
        f"{n} of {name}"
        for name, n in zip(("x", "y", *names), (*pixels, *decimals), strict=True)
        if n is not None
    ]
    return f"the decimals of the table ({', '.join(words)}) alone explain this scatter"


def _step(decimals: list[int | None]) -> float:
    """Largest unit of the last decimal; 0 if there are no decimals."""
    return max((10.0**-n for n in decimals if n is not None), default=0.0)


def _decimals(values: Float) -> int | None:
    """Decimals that numbers were rounded to; None if they have more than `MOST_DECIMALS`."""
    for n in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**n
        if np.abs(scaled - np.round(scaled)).max() <= NEARLY_WHOLE:
            return n
    return None


def _smallest_scatter(stars: Matches) -> float | None:
    """Smallest scatter about polynomials of several orders, on the axis where it is larger.

    It is the scatter of all stars about a polynomial of order `ORDER` for each chip and exposure,
    or that of the chip and exposure with the most stars about another order.  None for too few
    stars.
    """
    groups = stars.exposure * len(stars.chip_numbers) + stars.chip
    rows = np.flatnonzero(groups == np.argmax(np.bincount(groups)))
    rows = rows[:: -(-len(rows) // STARS_OF_OTHER_ORDERS)]
    pooled = _residuals_of_groups(stars)
    residuals = [] if pooled is None else [pooled]
    residuals += [
        _clipped_residuals(stars, rows, order, ORDER_ROUNDS)
        for order in OTHER_ORDERS
        if EACH * n_terms(order) <= len(rows) and (order > ORDER or pooled is None)
    ]
    return min((max(_robust(axis) for axis in each.T) for each in residuals), default=None)


def _on_a_line(stars: Matches) -> bool:
    """True if the reference positions form a line or a single point."""
    offsets = np.stack([stars.u - stars.u.mean(), stars.v - stars.v.mean()])
    long, short = np.linalg.svd(offsets, compute_uv=False)
    return bool(short <= ON_A_LINE * long)


def _doubts_on_order(stars: Matches, order: int) -> Iterator[str]:
    """Sentence about a polynomial order that is too low.

    It is tested on the exposure and chip with the most stars.  Positions that the polynomial cannot
    follow would be rejected or treated as false matches.
    """
    groups = stars.exposure * len(stars.chip_numbers) + stars.chip
    rows = np.flatnonzero(groups == np.argmax(np.bincount(groups)))
    rows = rows[:: -(-len(rows) // MOST_STARS)]
    higher = [n for n in range(order + 1, MAX_ORDER + 1) if EACH * n_terms(n) <= len(rows)]
    if not higher:
        return
    low, high = (_scatter_about(stars, rows, n) for n in (order, higher[-1]))
    if not low > LOW_ORDER * high > 0:
        return
    # Where stars are displaced as a whole, the scatter depends on which of them a fit rejects, and
    # peaks of the residuals do not: terms that a polynomial lacks widen these.
    widths = [_width_of_peak(stars, rows, n) for n in (order, higher[-1])]
    if not np.any(widths[0] > LOW_ORDER * widths[1]):
        return
    tried = ((n, _scatter_about(stars, rows, n)) for n in higher)
    best, lowest = next(trial for trial in tried if trial[1] <= BEST_ORDER * high)
    scale = _scale(stars) or 1.0
    yield (
        f"the positions scatter by {low / scale:.2g} px about a polynomial of order {order}, and "
        f"by {lowest / scale:.2g} px about one of order {best}: the order is too low, and matches "
        "that it does not follow are rejected or taken for false ones; raise model.order "
        "(bayesdist select-order CONFIG.toml compares orders)"
    )


def _doubts_on_dates(epochs: Float, where: str) -> Iterator[str]:
    """Sentences about unlikely epochs; raises InputError if they are not decimal years."""
    first, last = float(np.min(epochs)), float(np.max(epochs))
    for date in (first, last):
        if not 1800 <= date <= 2200:
            raise InputError(
                f"an epoch is {date:.10g}, and epochs are decimal years",
                where=where,
                do="convert it, or give the column the unit MJD or JD",
            )
    if first < YEARS[0] or last > YEARS[1]:
        yield f"epochs lie between {first:.1f} and {last:.1f}: check that they are decimal years"


def refuse_empty_segments(epochs: Float, time: TimeDependence | None) -> None:
    """Refuse a break of the drift if a segment before or after it has no data."""
    if time is None or not time.breaks:
        return
    counts = np.bincount(
        np.searchsorted(time.breaks, epochs, side="right"), minlength=time.n_segments
    )
    for k, n in enumerate(counts):
        if n == 0:
            date, side = (time.breaks[k - 1], "after") if k else (time.breaks[0], "before")
            raise InputError(
                f"there are no data {side} the break at {date:g}"
                + (f" and before that at {time.breaks[k]:g}" if 0 < k < len(time.breaks) else ""),
                where="model.tdd.breaks",
                do=f"leave it out: the data are of {np.min(epochs):.2f} to {np.max(epochs):.2f}",
            )


def scatter_about_polynomials(table: Matches) -> float | None:
    """Robust scatter per axis about a polynomial for each chip and exposure, to two digits.

    It is in the unit of u, v; None if there are too few stars.
    """
    residuals = _residuals_of_groups(table)
    return None if residuals is None else float(f"{_robust(residuals):.2g}")


def _residuals_of_groups(table: Matches) -> Float | None:
    """Residuals (M, 2) about a polynomial for each chip and exposure; None for too few stars."""
    groups = table.exposure * len(table.chip_numbers) + table.chip
    residuals = [
        _clipped_residuals(table, np.flatnonzero(groups == group), ORDER, ROUNDS)
        for group in np.flatnonzero(np.bincount(groups) >= EACH * n_terms(ORDER))
    ]
    return np.concatenate(residuals) if residuals else None


def _scatter_about(table: Matches, rows: Int, order: int) -> float:
    """Robust scatter per axis about one polynomial."""
    return _robust(_clipped_residuals(table, rows, order, ORDER_ROUNDS))


def _width_of_peak(table: Matches, rows: Int, order: int) -> Float:
    """Length (2,) of the shortest interval with a part `IN_PEAK` of the residuals, along u and v.

    The residuals are those of all rows, also of those that the fit of the polynomial rejects.
    """
    residuals = np.sort(_fitted(table, rows, order, ORDER_ROUNDS)[0], axis=0)
    n = int(IN_PEAK * len(residuals))
    return np.asarray((residuals[n:] - residuals[: len(residuals) - n]).min(axis=0))


def _robust(residuals: Float) -> float:
    return NORMAL * float(np.median(np.abs(residuals)))


def _clipped_residuals(table: Matches, rows: Int, order: int, rounds: int) -> Float:
    """Residuals (M, 2) of rows within `CLIP` of a polynomial fitted to these rows."""
    residuals, used = _fitted(table, rows, order, rounds)
    # corrected for the degrees of freedom of the fit
    return np.asarray(residuals[used] * np.sqrt(used.sum() / (used.sum() - n_terms(order))))


def _fitted(table: Matches, rows: Int, order: int, rounds: int) -> tuple[Float, Bool]:
    """Residuals (N, 2) of a polynomial, and mask of those within `CLIP` to which it was fitted."""
    i, j = np.array(polynomial_terms(order)).T
    X, Y = (2 * (z - z.min()) / max(np.ptp(z), 1.0) - 1 for z in (table.x[rows], table.y[rows]))
    basis = legendre.legvander(X, order)[:, i] * legendre.legvander(Y, order)[:, j]
    data = np.stack([table.u[rows], table.v[rows]], axis=-1)
    used = np.ones(len(X), bool)
    for _ in range(rounds):
        residuals = data - basis @ np.linalg.lstsq(basis[used], data[used])[0]
        size = NORMAL * np.median(np.abs(residuals[used]))
        inliers = (np.abs(residuals) <= CLIP * size).all(axis=1)
        if (inliers == used).all() or inliers.sum() < 2 * len(i):
            break
        used = inliers
    return np.asarray(residuals), used
