"""Bring-up of a calibration: alternate matching and fitting until the corners are covered.

See WSDC D-T033, sections 2 and 3.  If the distortion is poorly known, matches are found only near
the centre; each fit extends the area in which they can be found.  Three rules prevent the iteration
from following false matches.  A bin of the detector counts as covered only if it has more matches
than expected by chance.  Matches in other bins are not used.  The order of the polynomial increases
as the covered area grows.  `bayesdist wise bring-up` reads the star lists from files.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from astropy.table import Table
from scipy.stats import poisson

from bayesdist.app.screen import table_text
from bayesdist.app.store.record import record_folder, write_table
from bayesdist.data.detections import Detections
from bayesdist.data.matches import Matches
from bayesdist.data.matching.pairs import mutual_pairs
from bayesdist.data.repeated import first_duplicate
from bayesdist.data.tables.checks import row_number
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.names import find_columns
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.missions.wise.bands.measure import optical_models
from bayesdist.missions.wise.pairs.read import RVB_ALIASES, band_name
from bayesdist.missions.wise.pairs.rvb_pairs import RvbPairs, write_rvb
from bayesdist.missions.wise.pairs.section import RadialLimit
from bayesdist.missions.wise.published import WISE_ARRAYS
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import mesh
from bayesdist.utils.arrays import Bool, Float, Int

__all__ = ["BringUp", "bring_up"]

BINS = 12  # number of bins per axis for the coverage
FIRST_ORDER = 2  # polynomial order of the first fit; it increases by at most one per round
GROWS = 0.01  # smallest increase of the covered fraction that counts as growth
SETTLED = 0.005  # convergence: largest change of the model, relative to the radius in the centre

_COLUMNS = {
    "x": ("x",),
    "y": ("y",),
    "sigma": ("sigma",),
    "frame": RVB_ALIASES["exposure"],
}
_SHOWN = ("order", "n_pairs", "n_believed", "n_false", "coverage", "rms", "moved")


@dataclass(frozen=True, eq=False)
class Round:
    """Round of the bring-up: statistics of the matches and the fit."""

    order: int  # polynomial order of the fit
    acceptance: RadialLimit  # matching radius, from the centre to the corners
    n_pairs: int  # number of all matches
    n_believed: int  # number of matches in covered bins, which were fitted
    n_false: float  # expected number of false matches among those, from displaced detections
    coverage: float  # fraction of the bins with detections that are covered
    rms: float  # rms residual per axis of the matches that the fit used
    moved: float  # largest change of the model over the detector
    theta: Float  # (n_params,), parameters after the fit; terms above its order are zero


@dataclass(frozen=True, eq=False)
class BringUp:
    """Result of a bring-up.

    Parameters
    ----------
    rounds : tuple of Round
        Statistics of all rounds.
    fit : LinearFit
        Fit of the last round.
    matches : Matches
        Matches fitted in the last round; exposures are the frames.
    index, reference_index : ndarray of int, shape (n_believed,)
        Rows of these matches in the two lists.
    covered : ndarray of bool, shape (BINS, BINS)
        Bins [iy, ix] of the detector that are covered in the last round.
    settled : bool
        True if the iteration converged: the last fit did not change the model.
    """

    rounds: tuple[Round, ...]
    fit: LinearFit
    matches: Matches
    index: Int
    reference_index: Int
    covered: Bool
    settled: bool

    @property
    def sentence(self) -> str:
        """Convergence, coverage, number of matches and their rms as sentences for reports."""
        first, last = self.rounds[0], self.rounds[-1]
        end = "converged" if self.settled else "has NOT converged"
        out = (
            f"The calibration {end} in {len(self.rounds)} rounds: coverage rose from "
            f"{100 * first.coverage:.0f} % to {100 * last.coverage:.0f} % of the detector, "
            f"{last.n_believed} pairs with {last.rms:.3g} {self.fit.model.unit} rms, some "
            f"{last.n_false:.0f} of them false."
        )
        if last.coverage < 1.0:
            out += (
                f" {(~self.covered).sum()} of {self.covered.size} bins are not covered; "
                "there it is an extrapolation."
            )
        return out


def bring_up(
    detections: Detections,
    reference: Detections,
    model: DistortionModel,
    start: Float | None = None,
    *,
    acceptance: RadialLimit,
    max_rounds: int = 30,
) -> BringUp:
    """Match and fit alternately until the whole detector is covered and the model converges.

    While the coverage grows, matches are accepted within a radius that increases towards the
    corners, and the corners have extra weight in the fit.  Then the radius of the centre and equal
    weights are used everywhere.

    Parameters
    ----------
    detections : Detections
        Pixel positions on the detector, with errors; the exposures are the frames.
    reference : Detections
        Undistorted positions in the frames, with errors in the same unit.
    model : DistortionModel
        Model with one chip, without frames and time dependence.
    start : ndarray, shape (n_params,), optional
        Initial parameters; by default no distortion is assumed.
    acceptance : RadialLimit
        Matching radius of the first rounds.  In the centre it must exceed the initial offset.
    max_rounds : int
        Maximum number of rounds.

    Returns
    -------
    BringUp
        Check `settled`, which is False if `max_rounds` was not sufficient.

    Raises
    ------
    InputError
        If the model has several chips or frames, the initial parameters are invalid, stars have no
        errors, a detection is outside of the detector, or no bin of the detector has more matches
        than expected by chance.
    DegenerateError
        If too little of the detector is covered in the end (see `fit_linear`).
    """
    if len(model.chips) > 1 or model.n_frame or model.time is not None:
        raise InputError(
            "bring-up needs a model with one chip, without frames and time dependence",
            where="model",
            do="select one chip",
        )
    if start is not None and np.shape(start) != (model.n_params,):
        raise InputError(
            f"the start has shape {np.shape(start)}, but the model has {model.n_params} parameters",
            where="start",
            do="give the parameters of this model",
        )
    field = Field(detections, reference, model, BINS)
    theta = None if start is None else np.asarray(start, float)
    if not np.isfinite(field.positions(theta, field.grid)).all():
        raise InputError(
            "the initial positions are not finite over the detector",
            where="start",
            do="check the coefficients",
        )
    rounds: list[Round] = []
    rejection = (
        DEFAULT_REJECTION  # has extra weight in the corners, while the radius is larger there
    )
    rule, order, settled = acceptance, min(FIRST_ORDER, model.order), False
    while True:
        accepted = field.match(theta, rule, len(rounds) + 1)
        matches = field.table(accepted)
        # the last fit is of the complete model, and raises an error if the coverage is too low
        last = settled or len(rounds) + 1 >= max_rounds
        order = model.order if last else order
        fit = fit_linear(matches, model, rejection=rejection) if last else None
        now = _partial_fit(matches, model, order, rejection) if fit is None else fit
        moved = field.distance(theta, _in_model(now, model))
        theta = _in_model(now, model)
        rounds.append(
            Round(
                order=order,
                acceptance=rule,
                n_pairs=accepted.n_pairs,
                n_believed=len(accepted.index),
                n_false=accepted.n_false,
                coverage=accepted.coverage,
                rms=float(np.hypot(now.rms_u, now.rms_v) / np.sqrt(2)),
                moved=moved,
                theta=theta,
            )
        )
        unchanged = moved < SETTLED * acceptance.centre
        if fit is not None:
            covered = accepted.covered.reshape(BINS, BINS)
            return BringUp(
                tuple(rounds),
                fit,
                matches,
                accepted.index,
                accepted.partner,
                covered,
                settled and unchanged,
            )
        grew = len(rounds) < 2 or accepted.coverage > rounds[-2].coverage + GROWS
        if order == model.order and not grew:
            settled = rule.corner == rule.centre and unchanged
            rule = RadialLimit(acceptance.centre, acceptance.centre)
            rejection = replace(rejection, radial_weight=1.0)
        order = min(order + 1, model.order)


def _partial_fit(
    matches: Matches, model: DistortionModel, order: int, rejection: Rejection
) -> LinearFit:
    """Fit to the part of the detector that has matches, treated as a smaller detector."""
    low = [max(0.0, np.floor(z.min() - 0.5)) for z in (matches.x, matches.y)]
    high = [np.ceil(z.max() + 0.5) - 1.0 for z in (matches.x, matches.y)]
    chip = model.chips[0]
    part = Chip(
        chip.number,
        chip.name,
        (float(high[0] - low[0]), float(high[1] - low[1])),
        (chip.reference_pixel[0] - low[0], chip.reference_pixel[1] - low[1]),
    )
    moved = matches.with_columns(x=matches.x - low[0], y=matches.y - low[1])
    return fit_linear(moved, replace(model, order=order, chips=(part,)), rejection=rejection)


def _in_model(fit: LinearFit, model: DistortionModel) -> Float:
    """Parameters (n_params,) of the full model from a fit to a part of the detector."""
    if fit.model == model:
        return fit.mean
    basis, part = model.basis(), fit.model.basis()
    theta = np.zeros(model.n_params)
    for axis in (0, 1):
        monomial = np.zeros(basis.n_terms)
        monomial[: part.n_terms] = part.to_monomials(
            fit.mean[fit.model.coefficient_slice(None, axis)]
        )
        theta[model.coefficient_slice(None, axis)] = basis.from_monomials(monomial)
    return theta


# -- pairs ----------------------------------------------------------------------------------------


RARE = 1e-3  # probability by chance, over all bins combined
DISPLACED = 10.0  # displacement for chance matches, in units of the radius in the corners
GRID = 17  # points per axis at which models are compared
OF_THE_BEST = 0.5  # minimum fraction of matched detections, relative to that of good bins
_DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


@dataclass(frozen=True, eq=False)
class Believed:
    """Accepted matches, which are those in covered bins, and statistics of the matching."""

    index: Int  # rows of the matches in the detections
    partner: Int  # rows of the matches in the reference
    n_pairs: int  # number of all matches, including those outside of covered bins
    n_false: float  # expected number of false matches in covered bins
    covered: Bool  # (n_bins,), True for covered bins
    coverage: float  # fraction of the bins with detections that are covered


class Field:
    """Detections, reference stars and the bins of the detector."""

    def __init__(
        self, detections: Detections, reference: Detections, model: DistortionModel, bins: int
    ) -> None:
        self.detections, self.reference, self.model, self.bins = detections, reference, model, bins
        self.sigma = _errors(detections), _errors(reference)
        size = model.chips[0].size
        out = np.zeros(len(detections), bool)
        for z, n in zip((detections.x, detections.y), size, strict=True):
            out |= (z < 0.5) | (z > n + 0.5)
        if out.any():
            k = int(np.argmax(out))
            raise InputError(
                f"detection {k + 1} is at pixel ({detections.x[k]:.2f}, {detections.y[k]:.2f}), "
                f"outside of the {size[0]:g} x {size[1]:g} detector",
                where="detections",
                do="correct the detector's size or remove the row",
            )
        ix, iy = (
            np.clip(((z - 0.5) / n * bins).astype(np.int64), 0, bins - 1)
            for z, n in zip((detections.x, detections.y), size, strict=True)
        )
        self.code = iy * bins + ix
        self.size = size
        self.grid = Detections(*mesh(*(np.linspace(1.0, n, GRID) for n in size)))

    def positions(self, theta: Float | None, stars: Detections) -> Float:
        """Undistorted positions (N, 2) of stars; the pixel positions if `theta` is None."""
        return stars.points if theta is None else self.model.predict(theta, stars.x, stars.y)

    def distance(self, before: Float | None, now: Float) -> float:
        """Largest difference between two models over the detector."""
        step = self.positions(now, self.grid) - self.positions(before, self.grid)
        return float(np.hypot(*step.T).max())

    def _paired(self, position: Float, radius: Float) -> tuple[Int, Int]:
        """Rows (n,) of detections and reference stars that are mutual nearest neighbours."""
        stars, reference = self.detections, self.reference
        index, partner, _ = mutual_pairs(
            position,
            reference.points,
            radius,
            frame=stars.exposure,
            reference_frame=reference.exposure,
        )
        return index, partner

    def match(self, theta: Float | None, rule: RadialLimit, number: int) -> Believed:
        """Matches of round `number` in bins with more matches than expected by chance."""
        stars, n_bins = self.detections, self.bins**2
        position = self.positions(theta, stars)
        radius = rule.at(stars.x, stars.y, self.size)
        index, partner = self._paired(position, radius)
        # detections that are displaced by more than the distortion have only false matches
        chance = np.zeros(n_bins)
        for direction in _DIRECTIONS:
            moved = position + DISPLACED * rule.corner * np.array(direction)
            strangers, _ = self._paired(moved, radius)
            chance += np.bincount(self.code[strangers], minlength=n_bins) / len(_DIRECTIONS)
        count = np.bincount(self.code[index], minlength=n_bins)
        n_detections = np.bincount(self.code, minlength=n_bins)
        covered = _covered(count, n_detections, chance)
        good = covered[self.code[index]]
        if not good.any():
            raise InputError(
                f"{len(index)} pairs are found in round {number} and {chance.sum():.0f} are "
                "expected by chance, but no part of the detector has a significant excess",
                where="bring-up",
                do="check orientation, offset and scale of the frames, or give another start or "
                "a larger radius",
            )
        n, n_chance = int(n_detections[covered].sum()), float(chance[covered].sum())
        return Believed(
            index=index[good],
            partner=partner[good],
            n_pairs=len(index),
            # false matches occur only for detections that have no true match
            n_false=n_chance * (n - int(good.sum())) / (n - n_chance),
            covered=covered,
            coverage=float(covered.sum() / (n_detections > 0).sum()),
        )

    def table(self, found: Believed) -> Matches:
        """Accepted matches as a table, with the frames as exposures."""
        stars, reference = self.detections, self.reference
        sigma = np.hypot(self.sigma[0][found.index], self.sigma[1][found.partner])
        frames, exposure = np.unique(stars.exposure[found.index], return_inverse=True)
        return Matches.of_distinct_rows(  # no detection has two reference stars
            x=stars.x[found.index],
            y=stars.y[found.index],
            u=reference.x[found.partner],
            v=reference.y[found.partner],
            sigma_u=sigma,
            sigma_v=sigma,
            unit=self.model.unit,
            exposure=exposure,
            exposure_names=tuple(stars.exposure_names[f] for f in frames),
            chip_numbers=(self.model.chips[0].number,),
            sources=("bring-up",),
        )


def _errors(stars: Detections) -> Float:
    """Errors (N,) of stars; raises InputError if there are none."""
    if stars.sigma is None:
        raise InputError("has no errors", where=stars.source, do="give sigma")
    return stars.sigma


def _covered(count: Int, there: Int, chance: Float) -> Bool:
    """Boolean mask (n_bins,) that is True for covered bins.

    Covered bins have more matches than expected by chance, and a fraction of matched detections
    not far below that of the best bins.  `count`, `there` and `chance` are the numbers of matches,
    of detections, and of matches of displaced detections in each bin.
    """
    has = there > 0
    expected = np.maximum(chance, there * (chance.sum() / there.sum()))
    # significant: for all bins combined the probability by chance is RARE
    clear = poisson.sf(count - 1, expected) < RARE / has.sum()
    excess = np.divide(count - expected, there, out=np.zeros(len(there)), where=has)
    if not clear.any():
        return np.zeros(len(there), bool)
    return np.asarray(clear & (excess > OF_THE_BEST * np.quantile(excess[clear], 0.9)))


def bring_up_files(
    detections: str | Path,
    reference: str | Path,
    output: str | Path,
    *,
    band: str,
    radius: float,
    corner_radius: float,
    order: int,
    optical: str | Path | None,
    rotation: float,
    command: str,
) -> str:
    """Match and fit star lists, and write the resulting pairs; returns text to print.

    Positions of the reference stars are those on an undistorted array in the frame, in pixels.  The
    new folder contains pairs/ for `format = "rvb"`, and rounds.ecsv.
    """
    band = band_name(band)
    array = WISE_ARRAYS[band]
    model = DistortionModel(order, (Chip(1, band, array.size, array.centre),))
    start = None if optical is None else _start(model, band, optical, rotation)
    stars, reference_stars = _read_lists(Path(detections), Path(reference))
    up = bring_up(
        stars, reference_stars, model, start, acceptance=RadialLimit(radius, corner_radius)
    )
    rows = [{"round": k, **asdict(bring_up_round)} for k, bring_up_round in enumerate(up.rounds, 1)]
    rows = [{name: row[name] for name in ("round", *_SHOWN)} for row in rows]
    with record_folder(Path(output), "bring_up.json", command) as (folder, record):
        write_rvb([_pairs(up, band)], folder / "pairs")
        write_table(Table(rows), folder / "rounds.ecsv")
        record |= {"band": band, "order": order, "verdict": up.sentence}
    return f"{table_text(rows, 4)}\n{up.sentence}\n{output}/pairs: calibrate with format = 'rvb'"


def _start(model: DistortionModel, band: str, optical: str | Path, rotation: float) -> Float:
    """Parameters of an optical model, without terms beyond the order of the model."""
    chip = model.chips[0]
    field = optical_models([optical], rotation, [band])[band].field(chip, WISE_ARRAYS[band].scale)
    basis = model.basis()
    coefficients = np.zeros((2, basis.n_terms))
    n = min(basis.n_terms, field.polynomial.shape[1])
    coefficients[:, :n] = field.polynomial[:, :n]
    # add the pixel positions to the distortion
    coefficients[:, 0] += chip.reference_pixel
    coefficients[:, 1:3] += np.diag(basis.half_size)
    return coefficients.ravel()


def _read_lists(*paths: Path) -> list[Detections]:
    """Read star lists and number their frames consistently."""
    columns, frames = [], []
    for path in paths:
        table = read_table(path)
        column_of = find_columns(table.colnames, None, _COLUMNS, source=str(path))
        missing = [name for name in _COLUMNS if name not in column_of]
        if missing:
            raise InputError(
                f"has no column {missing[0]!r} among {', '.join(table.colnames)}",
                where=str(path),
                do="give x, y, sigma and frame",
            )
        column = {name: SourceColumn(table[key], str(path), key) for name, key in column_of.items()}
        columns.append([column[name].numbers() for name in ("x", "y", "sigma")])
        codes, names = column["frame"].labels()
        pair = first_duplicate([*columns[-1], codes])
        if pair is not None:
            first, second = map(row_number, pair)
            raise InputError(
                f"repeats {first}", where=f"{path}, {second}", do="list each detection once"
            )
        frames.append(np.array(names, str)[codes])
    unique, code = np.unique(np.concatenate(frames), return_inverse=True)
    parts = np.split(code, np.cumsum([len(column) for column in frames])[:-1])
    numbers = tuple(map(str, range(len(unique))))
    return [
        Detections(x, y, part, numbers, sigma=sigma, source=str(path))
        for (x, y, sigma), part, path in zip(columns, parts, paths, strict=True)
    ]


def _pairs(up: BringUp, band: str) -> RvbPairs:
    """Accepted pairs of the last round."""
    return RvbPairs(replace(up.matches, filter_names=(band,)))
