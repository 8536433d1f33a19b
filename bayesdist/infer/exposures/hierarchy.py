"""Joint fit of all exposures, with random deviations of scale and shear from exposure to exposure.

    deviation k of exposure e ~ N(0, tau_k^2)     k: scale, shear_plus, shear_cross, and with
                                                  `chip_deviations` shift, rotation, scale and shear
                                                  of every chip but the first

Because of the breathing of a telescope, the linear terms of its exposures scatter by more than
their formal errors.  A joint fit that ignores this treats every star as an independent measurement
of the detector.  The scatter tau is estimated together with all other parameters.

The gap between chips may change together with scale and shear, or drift independently.  It is
therefore used neither as a ruler nor as an independent measurement (see `CAUTION`).  The positions
of the chips are computed afterwards (see `Settling`).

One linear fit with a wide prior on the deviations is sufficient.  Its normal equations give the
likelihood of the deviations; tau, and all parameters conditional on tau, follow algebraically (see
`Scatter`).

The data determine only the sums of a chip's constant terms and its shifts in each exposure, but
these very well.  In the fit the shifts get a wide prior, so that they do not constrain other
parameters; the constants are then as uncertain as that prior.  `Settling` determines the constants
from the mean of the sums over the exposures, with the error that results from the scatter of the
shifts:

    c -> c + G s + d      s -> s - X (G s + d)      d ~ N(0, tau^2 (X^T X)^-1)

G is the least-squares regression of the shifts s on X, which has a column of ones and, if the drift
has breaks, its steps.  The predicted positions of all exposures are unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.normal import least_squares
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.exposures.scatter import Scatter
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import bare_model, reference_gauge
from bayesdist.infer.stars.likelihood import ClippedGaussian
from bayesdist.infer.stars.loading import opened
from bayesdist.infer.stars.shards import Shards
from bayesdist.model import DistortionModel, Groups
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.distributions import f_sf
from bayesdist.utils.quantities import Random, generator_of

SCALE = 1e-4  # scale of the prior on tau: annual change of the scale by velocity aberration
# Breathing also moves the chips of a focal plane. In that case the deviations of the gap repeat
# those of scale and shear, and treating them as independent would halve the error of a drift.
# Multiplying their scatter by four limits the reduction to 3 %.
CAUTION = 4.0
MOST_OUTLYING = 0.2  # with a larger fraction, exposures are not treated as outlying
# smallest sum, over the E deviations of a kind, of the fraction determined by the data
LEAST_DETERMINED = 0.5
FEWEST_FREE = 3  # smallest number of degrees of freedom for a test of trends

AXES = ("u", "v")


@dataclass(frozen=True, eq=False)
class HierarchicalFit(Solution):
    """Joint solution of all exposures, with random deviations of scale and shear per exposure.

    Draws, mean and covariance are marginalised over the scatter tau, with one approximation: the
    conditional covariance for given tau is computed at the root mean square of tau.  Since
    variances are linear in tau^2 or concave, this overestimates rather than underestimates them.

    Parameters
    ----------
    fit : LinearFit
        Linear fit with tau fixed to its root mean square.
    scatter : Scatter
        Likelihood of the deviations and prior of tau.
    tau_draws : ndarray, shape (n, k)
        Draws from the posterior of tau for k kinds of deviation.
    others : GaussianPriors
        Priors on other parameters, as given to `fit_hierarchical`.
    settling : Settling
        Transformation of the constants and shifts of single chips, which is also applied to `fit`.
    outlying : tuple of str
        Names of the exposures with deviations far beyond the scatter of the others. They are fitted
        with a wide prior and do not contribute to tau.
    """

    fit: LinearFit
    scatter: Scatter
    tau_draws: Float
    others: GaussianPriors
    settling: Settling
    outlying: tuple[str, ...] = ()

    @property
    def index(self) -> Int:
        """Indices (m,) in theta of the deviations."""
        return self.scatter.index

    @cached_property
    def model(self) -> DistortionModel:
        """The distortion model."""
        return self.fit.model

    @property
    def likelihood(self) -> ClippedGaussian:
        """Gaussian likelihood at the posterior mean, for the stars that the rejection keeps."""
        return ClippedGaussian(self.mean, self.fit.clip)

    def uses(self, matches: Matches) -> Bool:
        """Boolean mask (N,) that is True for the stars that pass the rejection limits."""
        return self.fit.uses(matches)

    @property
    def tau(self) -> dict[str, float]:
        """Posterior median of tau by kind of deviation, in the unit of the parameter."""
        median = np.median(self.tau_draws, axis=0)
        return dict(zip(self.scatter.kinds, map(float, median), strict=True))

    def tau_interval(self, probability: float = 0.68) -> dict[str, tuple[float, float]]:
        """Central credible interval of tau by kind of deviation.

        Parameters
        ----------
        probability : float
            Posterior probability of the interval, between 0 and 1.

        Returns
        -------
        dict of str to (float, float)
            Lower and upper end, in the unit of the parameter.
        """
        tail = (1 - probability) / 2
        ends = np.quantile(self.tau_draws, [tail, 1 - tail], axis=0).T
        return {k: (float(a), float(b)) for k, (a, b) in zip(self.scatter.kinds, ends, strict=True)}

    @property
    def priors(self) -> GaussianPriors:
        """Priors on the deviations and on other parameters, to be passed to `sample`."""
        return _with_deviations(
            self.others, self.index, self.scatter.prior(_root_mean_square(self.tau_draws))
        )

    @cached_property
    def _means(self) -> Float:
        """Conditional mean of theta for each draw of tau, shape (n, D)."""
        return self.settling.mean(
            np.stack([self.scatter.posterior(tau)[0] for tau in self.tau_draws])
        )

    @cached_property
    def mean(self) -> Float:
        """Posterior mean of theta, shape (D,)."""
        return np.asarray(self._means.mean(axis=0))

    @cached_property
    def cov(self) -> Float:
        """Posterior covariance of theta, shape (D, D)."""
        spread = self._means - self.mean
        return np.asarray(self.fit.cov + spread.T @ spread / len(spread))

    @one_thread
    def draws(self, n: int, rng: Random) -> Float:
        """Draws of theta, each conditional on a draw of tau; see `Solution.draws`."""
        generator = generator_of(rng)
        tau_rows = np.sort(generator.integers(len(self.tau_draws), size=n))
        theta = generator.standard_normal((n, len(self.fit.mean)))
        for t in np.unique(tau_rows):
            rows = tau_rows == t
            mean, factor = self.scatter.posterior(self.tau_draws[t])
            theta[rows] = mean + factor.colour(theta[rows])
        return np.asarray(
            generator.permutation(self.settling.draws(theta, self.tau_draws[tau_rows], generator))
        )


def _root_mean_square(tau: Float) -> Float:
    return np.asarray(np.sqrt((tau**2).mean(axis=0)))


def _with_deviations(others: GaussianPriors, index: Int, inverse_variance: Float) -> GaussianPriors:
    centre, precision = others.centre.copy(), others.precision.copy()
    centre[index], precision[index] = 0.0, inverse_variance
    return GaussianPriors(centre, precision)


def held_in_reference(matches: Matches, model: DistortionModel, chip: int = 2) -> DistortionModel:
    """Convert a model to gauge 'held', with u, v along the axes of the reference chip.

    The stars of the first exposure on that chip are fitted by themselves.  The position and the
    rotation at the chip's reference pixel define the frame of the first exposure.  Frames then
    rotate about the reference pixel, and scale, shear and drift refer to the detector, independent
    of the roll angles.

    Parameters
    ----------
    matches : Matches
        Stars with errors.
    model : DistortionModel
        Model of all exposures; its gauge is replaced.
    chip : int
        Number of the reference chip.

    Returns
    -------
    DistortionModel

    Raises
    ------
    DegenerateError
        If the first exposure has too few stars on the reference chip.
    """
    first = model.exposures[0]
    number = model.chips[model.chip_code(chip)].number
    parts = []
    for table in matches.batches():
        rows = np.asarray(table.exposure_names)[table.exposure] == first
        rows &= table.chip_number == number
        if rows.any():
            parts.append(table.select(rows))
    if not parts:
        raise DegenerateError(
            f"exposure {first!r}, which defines the gauge, has no stars on the reference chip",
            where=f"chip {model.chips[model.chip_code(chip)].name}",
            do="put another exposure first",
        )
    alone = replace(bare_model(model), chips=(model.chips[model.chip_code(chip)],), time=None)
    table = Matches.concatenate(parts)
    gauge = reference_gauge(fit_linear(table, alone), chip).gauge
    return replace(model, gauge="held", held=(*gauge.shift, -gauge.rotation), origin=(0.0, 0.0))


@one_thread
def fit_hierarchical(
    matches: Matches | Shards,
    model: DistortionModel,
    *,
    priors: GaussianPriors | None = None,
    scale: float = SCALE,
    pixel: float = 1.0,
    n_tau: int = 256,
    seed: int = 1,
    rejection: Rejection = DEFAULT_REJECTION,
) -> HierarchicalFit:
    """Fit all exposures jointly, with random deviations of their scale and shear.

    Parameters
    ----------
    matches : Matches or Shards
        Stars with errors.
    model : DistortionModel
        Model with frames 'shift_rotation_scale' or 'affine', or with deviations of single chips, in
        gauge 'held'; see `held_in_reference`.
    priors : GaussianPriors, optional
        Priors on other parameters; flat by default.
    scale : float
        Scale of the half-Student-t prior (4 degrees of freedom) on each tau. The prior is nearly
        flat for a much smaller scatter, and makes the posterior proper if there are few exposures.
        For shifts of single chips, it is multiplied by half the longest side of a chip.
    pixel : float
        Size of a pixel in the unit of u, v.
    n_tau : int
        Number of draws of tau over which results are averaged.
    seed : int
        Seed of these draws.
    rejection : Rejection
        Rejection limits and weights; see `fit_linear`.

    Returns
    -------
    HierarchicalFit

    Raises
    ------
    InputError
        If the model has no such frames, or another gauge.
    DegenerateError
        If the data do not determine a scatter (the message names it) or the model (see
        `fit_linear`).
    """
    kinds = model.free_frame_names(0) if model.gauge == "held" else ()
    if not kinds:
        raise InputError(
            f"frames '{model.frames}' in gauge '{model.gauge}' have no deviations to estimate",
            where="model.frames",
            do="choose 'shift_rotation_scale' or 'affine' in gauge 'held' (held_in_reference)",
        )
    other_priors = priors or GaussianPriors.none(model)
    names = {name: k for k, name in enumerate(model.names)}
    index = np.array([names[f"{e}.{kind}"] for kind in kinds for e in model.exposures])
    n = len(model.exposures)
    kind, member = np.divmod(np.arange(len(index)), n)
    half = max(max(chip.size) for chip in model.chips) / 2
    of_gap = np.array(["shift" in name for name in kinds])
    scales = scale * np.where(of_gap, half * pixel, 1.0)
    with opened(model, matches) as shards:
        wide = _with_deviations(other_priors, index, scales[kind] ** -2)
        first = fit_linear(shards, model, rejection=rejection, priors=wide)
        equations = shards.sum(least_squares, first.mean, first.clip)
        matrix, right = equations.assemble(model, first.mean)
        scatter = Scatter(
            kinds,
            kind,
            index,
            matrix + other_priors.matrix(model),
            right + other_priors.pull(first.mean),
            first.mean,
            scales,
            np.zeros(len(index), bool),
            np.where(of_gap, CAUTION, 1.0),
        )
        _require_determined(scatter, model)
        outlying = _outlying(scatter, member)
        scatter = scatter.loosened(outlying[member])
        tau_draws = scatter.draws(n_tau, np.random.default_rng(seed))
        precision = scatter.prior(_root_mean_square(tau_draws))
        final_priors = _with_deviations(other_priors, index, precision)
        fit = fit_linear(shards, model, rejection=rejection, priors=final_priors)
        settling = Settling.of(model, kinds, equations.groups, other_priors.precision > 0, outlying)
    fit = replace(
        fit,
        mean=settling.mean(fit.mean),
        cov=settling.covariance(fit.cov, _root_mean_square(tau_draws)),
    )
    names_of = tuple(model.exposures[e] for e in np.flatnonzero(outlying))
    return HierarchicalFit(fit, scatter, tau_draws, other_priors, settling, names_of)


def _outlying(scatter: Scatter, member: Int) -> Bool:
    """Boolean mask (E,) of outlying exposures.

    The most deviant exposure is removed, tau is estimated from the remaining ones, and so on.  If
    more than a fifth of the exposures were outlying, none is marked.
    """
    n = int(member.max()) + 1
    outlying = np.zeros(n, bool)
    while outlying.sum() <= MOST_OUTLYING * n:
        remaining = scatter.loosened(outlying[member])
        odds = remaining.odds(np.exp(remaining.mode()), member)
        odds[outlying] = -np.inf
        worst = int(np.argmax(odds))
        if odds[worst] <= 0:
            return outlying
        outlying[worst] = True
    return np.zeros(n, bool)


def _require_determined(scatter: Scatter, model: DistortionModel) -> None:
    """Raise DegenerateError if the data hardly constrain a kind of deviation beyond its prior."""
    _, factor = scatter.posterior(scatter.scale / scatter.caution)
    # fraction of the information on each deviation that comes from the data rather than the prior
    from_data = 1 - factor.variances()[scatter.index] / scatter.scale[scatter.kind] ** 2
    determined = np.bincount(scatter.kind, from_data)
    if (determined < LEAST_DETERMINED).any():
        worst = scatter.kinds[int(np.argmin(determined))]
        n = len(scatter.kind) // len(scatter.kinds)
        drifts = model.time is not None
        raise DegenerateError(
            f"the scatter of {worst!r} is not determined: the linear "
            f"terms{' and their drift' if drifts else ''} can fit {n} exposures exactly",
            where="exposures",
            do="give more exposures, or "
            + (
                "drop the drift (model.tdd)"
                if drifts
                else "calibrate matched stars ([data] instead of [campaign], model.frames = "
                "'shift_rotation_scale')"
            ),
        )


def trend_p_values(values: Float, epoch: Float, breaks: ArrayLike = ()) -> Float:
    """F-test for linear trends of the deviations with time.

    A line in each time segment is compared with a constant in each segment.  The noise is estimated
    from the scatter of the exposures about the lines, which includes all noise of the deviations.

    Parameters
    ----------
    values : ndarray, shape (E, k)
        Deviations of E exposures, of k kinds.
    epoch : ndarray, shape (E,)
        Dates of the exposures in decimal years.
    breaks : array_like
        Dates at which the second and later segments begin.

    Returns
    -------
    ndarray, shape (k,)
        Chance probability of a trend at least as large, for each kind; 1 if there are too few
        exposures.
    """
    segment = np.searchsorted(np.asarray(breaks, float), epoch, side="right")
    constant = (segment[:, None] == np.unique(segment)).astype(float)
    middle = constant.T @ epoch / constant.sum(axis=0)
    lines = constant * (epoch[:, None] - middle)
    lines = lines[:, np.ptp(lines, axis=0) > 0]
    free = len(epoch) - constant.shape[1] - lines.shape[1]
    if free < FEWEST_FREE or not lines.shape[1]:
        return np.ones(values.shape[1])
    flat, bent = (
        values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        for design in (constant, np.column_stack([constant, lines]))
    )
    residual = (bent**2).sum(axis=0)
    gain = np.maximum((flat**2).sum(axis=0) - residual, 0.0)
    ratio = np.divide(
        gain / lines.shape[1], residual / free, out=np.zeros_like(gain), where=residual > 0
    )
    return np.asarray(f_sf(ratio, lines.shape[1], free))


# -- constant terms of chips that shift from exposure to exposure ----------------------------------


@dataclass(frozen=True, eq=False)
class _Place:
    """Constants and shifts of one axis of one chip."""

    kind: int  # index of its shifts among the kinds of deviation
    constants: Int  # indices (p,) in theta of the constant term and its steps
    shifts: Int  # indices (E,) in theta of the shifts
    design: Float  # X (E, p)
    used: Bool  # mask (E,) of the exposures that are used for the mean

    @property
    def inverse(self) -> Float:
        """(X^T X)^-1, shape (p, p)."""
        design = self.design[self.used]
        return np.asarray(np.linalg.inv(design.T @ design))

    def moved(self, theta: Float, d: Float) -> None:
        """Transform theta (..., D) in place, with errors d (..., p) of the constants."""
        shifts = theta[..., self.shifts]
        step = shifts[..., self.used] @ self.design[self.used] @ self.inverse + d
        theta[..., self.constants] += step
        theta[..., self.shifts] -= step @ self.design.T

    def covariance(self, n: int, tau: float) -> Float:
        """Covariance (n, n) of theta caused by the errors d of the constants, for scatter tau."""
        by = np.zeros((n, len(self.constants)))
        by[self.constants] = np.eye(len(self.constants))
        by[self.shifts] = -self.design
        return tau**2 * by @ self.inverse @ by.T


@dataclass(frozen=True, eq=False)
class Settling:
    """Transformation that determines the constants of chips from the mean of their shifts."""

    places: tuple[_Place, ...]  # one per axis of every chip except the first

    @classmethod
    def of(
        cls,
        model: DistortionModel,
        kinds: Sequence[str],
        groups: Groups,
        held: Bool,
        outlying: Bool,
    ) -> Settling:
        """Make the transformation for the shifts of single chips among the kinds of deviation.

        `groups` of the data provide the chips and the epoch of each exposure.  `held` (D,) is True
        for parameters with other priors, and `outlying` (E,) for outlying exposures.
        """
        names = {name: k for k, name in enumerate(model.names)}
        places = []
        for code, chip in enumerate(model.chips):
            present = np.zeros(len(model.exposures), bool)
            epoch = np.zeros(len(model.exposures))
            on_chip = groups.chip == code
            present[groups.exposure[on_chip]] = True
            epoch[groups.exposure[on_chip]] = groups.epoch[on_chip]
            for a, axis in enumerate(AXES):
                kind = f"{chip.name}.shift_{axis}"
                if kind not in kinds:
                    continue
                at, X = [model.coefficient_slice(chip.number, a).start], [np.ones(len(present))]
                if model.time is not None and (axis, 0, 0) in model.time.terms:
                    weights = model.time.weights(epoch)
                    first = model.tdd_slice(chip.number).start
                    first += model.time.terms.index((axis, 0, 0)) * model.time.n_values
                    free = ~held[first : first + model.time.n_values]
                    at += (first + np.flatnonzero(free)).tolist()
                    X += list(weights.T[free])
                shifts = [names[f"{e}.{kind}"] for e in model.exposures]
                used = present & ~outlying
                design = np.stack(X, axis=1)
                if np.linalg.matrix_rank(design[used]) == len(at):
                    places.append(
                        _Place(
                            list(kinds).index(kind), np.array(at), np.array(shifts), design, used
                        )
                    )
        return cls(tuple(places))

    def mean(self, theta: Float) -> Float:
        """Transformed theta (..., D), with d = 0."""
        out = np.array(theta, float)
        for place in self.places:
            place.moved(out, np.zeros(len(place.constants)))
        return out

    def covariance(self, cov: Float, tau: Float) -> Float:
        """Covariance (D, D) of transformed parameters, from `cov` (D, D) and scatter tau (k,)."""
        out = self.mean(self.mean(np.asarray(cov)).T)
        for place in self.places:
            out += place.covariance(len(out), float(tau[place.kind]))
        return np.asarray((out + out.T) / 2)

    def draws(self, theta: Float, tau: Float, rng: np.random.Generator) -> Float:
        """Transformed draws (n, D), each with a random d for its scatter tau (n, k)."""
        out = np.array(theta, float)
        for place in self.places:
            root = np.linalg.cholesky(place.inverse)
            z = rng.standard_normal((len(out), len(place.constants)))
            place.moved(out, tau[:, [place.kind]] * z @ root.T)
        return out
