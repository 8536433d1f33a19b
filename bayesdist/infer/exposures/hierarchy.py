"""Joint fit of all exposures, with scale and shear of each scattered about the common polynomials.

    deviation k of exposure e ~ N(0, tau_k^2)     k: scale, shear_plus, shear_cross, and with
                                                  `chip_deviations` shift, rotation, scale and shear
                                                  of every chip but the first

A telescope breathes: the linear terms of its exposures scatter by more than their formal errors,
and a joint fit that ignores this takes each star as if it were a new measurement of the detector.
The scatter tau is estimated with everything else.

How the distance between chips changes with scale and shear is left open: it is no ruler, as it may
drift by itself, and no measurement of its own (see `CAUTION`); the positions of the chips are
computed afterwards (see `Settling`).

One linear fit with a wide prior on the deviations is enough.  Its normal equations give the
likelihood of the deviations; tau, and all parameters given tau, then follow by algebra (see
`Scatter`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.normal import least_squares
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.exposures.chip_offsets import Settling
from bayesdist.infer.exposures.scatter import Scatter
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import bare_model, reference_gauge
from bayesdist.infer.stars.likelihood import ClippedGaussian
from bayesdist.infer.stars.loading import opened
from bayesdist.infer.stars.shards import Shards
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.distributions import f_sf
from bayesdist.utils.quantities import Random, generator_of

SCALE = 1e-4  # of the prior on tau: variation of the scale by velocity aberration in a year
# A focal plane that breathes moves its chips too: then the gap's deviations repeat those of scale
# and shear, and taken as independent they would halve the error of a drift.  At four times their
# scatter they reduce it by 3 %.
CAUTION = 4.0
MOST_OUTLYING = 0.2  # fraction of the exposures beyond which they are the rule
# smallest sum over E deviations of a kind of the parts that the data determine
LEAST_DETERMINED = 0.5
FEWEST_FREE = 3  # degrees of freedom left by the lines


@dataclass(frozen=True, eq=False)
class HierarchicalFit(Solution):
    """A joint solution of all exposures in which scale and shear of each may deviate.

    Draws and mean are over the posterior of tau.  So is the covariance, but for one simplification:
    its part within one tau is computed at the root mean square of tau.  Variances are linear in
    tau^2 where the scatter dominates, and more concave elsewhere, so that this errs to the safe
    side.

    Parameters
    ----------
    fit : LinearFit
        The linear fit with tau fixed at its root mean square.
    scatter : Scatter
        Likelihood of the deviations and prior of tau.
    tau_draws : ndarray, shape (n, k)
        Draws of tau from its posterior.
    others : GaussianPriors
        The priors that were given.
    settling : Settling
        Transformation, made in `fit` too, of the shifts of single chips.
    outlying : tuple of str
        Exposures whose deviations are far beyond the scatter of the others.  They are fitted with a
        wide prior, and do not enter tau.
    """

    fit: LinearFit
    scatter: Scatter
    tau_draws: Float
    others: GaussianPriors
    settling: Settling
    outlying: tuple[str, ...] = ()

    @property
    def index(self) -> Int:
        """Indices in theta of the deviations."""
        return self.scatter.index

    @cached_property
    def model(self) -> DistortionModel:
        """The distortion model."""
        return self.fit.model

    @property
    def likelihood(self) -> ClippedGaussian:
        """Normal errors of the stars in the second pass, at the mean."""
        return ClippedGaussian(self.mean, self.fit.clip)

    def uses(self, matches: Matches) -> Bool:
        """Boolean mask (N,) of a table's stars that were used."""
        return self.fit.uses(matches)

    @property
    def tau(self) -> dict[str, float]:
        """Posterior median of the scatter of each kind of deviation."""
        median = np.median(self.tau_draws, axis=0)
        return dict(zip(self.scatter.kinds, map(float, median), strict=True))

    def tau_interval(self, probability: float = 0.68) -> dict[str, tuple[float, float]]:
        """Central posterior interval of each tau."""
        tail = (1 - probability) / 2
        ends = np.quantile(self.tau_draws, [tail, 1 - tail], axis=0).T
        return {k: (float(a), float(b)) for k, (a, b) in zip(self.scatter.kinds, ends, strict=True)}

    @property
    def priors(self) -> GaussianPriors:
        """Given priors and those of the deviations, as arguments for `sample`."""
        return _with_deviations(
            self.others, self.index, self.scatter.prior(_root_mean_square(self.tau_draws))
        )

    @cached_property
    def _means(self) -> Float:
        """Mean of theta for each draw of tau, shape (n, D)."""
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
        """Parameter vectors (n, D), each drawn given a tau of its own."""
        generator = generator_of(rng)
        which = np.sort(generator.integers(len(self.tau_draws), size=n))
        theta = generator.standard_normal((n, len(self.fit.mean)))
        for t in np.unique(which):
            rows = which == t
            mean, factor = self.scatter.posterior(self.tau_draws[t])
            theta[rows] = mean + factor.colour(theta[rows])
        return np.asarray(
            generator.permutation(self.settling.draws(theta, self.tau_draws[which], generator))
        )


def _root_mean_square(tau: Float) -> Float:
    return np.asarray(np.sqrt((tau**2).mean(axis=0)))


def _with_deviations(others: GaussianPriors, index: Int, inverse_variance: Float) -> GaussianPriors:
    centre, precision = others.centre.copy(), others.precision.copy()
    centre[index], precision[index] = 0.0, inverse_variance
    return GaussianPriors(centre, precision)


def held_in_reference(matches: Matches, model: DistortionModel, chip: int = 2) -> DistortionModel:
    """Model in gauge 'held', with polynomials along the reference chip's axes.

    The first exposure's stars on that chip are fitted alone; position and rotation of its reference
    pixel fix the first exposure.  Frames then rotate about the reference pixel, and scale, shear
    and drift are those of the detector, whatever the roll angles are.

    Parameters
    ----------
    matches : Matches
    model : DistortionModel
        Of all exposures; its gauge is replaced.
    chip : int
        Number of the reference chip.

    Returns
    -------
    DistortionModel

    Raises
    ------
    DegenerateError
        When the first exposure has too few stars on that chip.
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
    """Fit all exposures jointly, with the scatter of their scale and shear.

    Parameters
    ----------
    matches : Matches or Shards
        With errors.
    model : DistortionModel
        Frames 'shift_rotation_scale' or 'affine', or deviations of single chips, in gauge 'held':
        see `held_in_reference`.
    priors : GaussianPriors, optional
        On other parameters.
    scale : float
        Of the half-Student-t prior on each tau, with 4 degrees of freedom.  It is flat for scatter
        much below, and makes the posterior proper with few exposures.  For shifts of single chips
        it counts at half the longest side of a chip.
    pixel : float
        Size of a pixel in the unit of u, v.
    n_tau : int
        Draws of tau over which results are averaged.
    seed : int
        Of these draws.
    rejection : Rejection
        As of `fit_linear`.

    Returns
    -------
    HierarchicalFit

    Raises
    ------
    InputError
        For a model without such frames, or another gauge.
    DegenerateError
        When the data do not determine the scatter, by name; else as `fit_linear`.
    """
    kinds = model.free_frame_names(0) if model.gauge == "held" else ()
    if not kinds:
        raise InputError(
            f"frames '{model.frames}' in gauge '{model.gauge}' leave nothing that scatters",
            where="model.frames",
            do="choose 'shift_rotation_scale' or 'affine' in gauge 'held' (held_in_reference)",
        )
    others = priors or GaussianPriors.none(model)
    names = {name: k for k, name in enumerate(model.names)}
    index = np.array([names[f"{e}.{kind}"] for kind in kinds for e in model.exposures])
    n = len(model.exposures)
    kind, member = np.divmod(np.arange(len(index)), n)
    half = max(max(chip.size) for chip in model.chips) / 2
    of_gap = np.array(["shift" in name for name in kinds])
    scales = scale * np.where(of_gap, half * pixel, 1.0)
    with opened(model, matches) as shards:
        wide = _with_deviations(others, index, scales[kind] ** -2)
        first = fit_linear(shards, model, rejection=rejection, priors=wide)
        equations = shards.sum(least_squares, first.mean, first.clip)
        matrix, right = equations.assemble(model, first.mean)
        scatter = Scatter(
            kinds,
            kind,
            index,
            matrix + others.matrix(model),
            right + others.pull(first.mean),
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
        known = _with_deviations(others, index, precision)
        fit = fit_linear(shards, model, rejection=rejection, priors=known)
        settling = Settling.of(model, kinds, equations.groups, others.precision > 0, outlying)
    fit = replace(
        fit,
        mean=settling.mean(fit.mean),
        cov=settling.covariance(fit.cov, _root_mean_square(tau_draws)),
    )
    names_of = tuple(model.exposures[e] for e in np.flatnonzero(outlying))
    return HierarchicalFit(fit, scatter, tau_draws, others, settling, names_of)


def _outlying(scatter: Scatter, member: Int) -> Bool:
    """Boolean mask (E,) of exposures that went wrong, removed one by one, the worst first.

    Tau is that of the remaining ones.  None are named where they are more than a fifth: then they
    are the rule.
    """
    n = int(member.max()) + 1
    found = np.zeros(n, bool)
    while found.sum() <= MOST_OUTLYING * n:
        some = scatter.loosened(found[member])
        odds = some.odds(np.exp(some.mode()), member)
        odds[found] = -np.inf
        worst = int(np.argmax(odds))
        if odds[worst] <= 0:
            return found
        found[worst] = True
    return np.zeros(n, bool)


def _require_determined(scatter: Scatter, model: DistortionModel) -> None:
    """Raise DegenerateError where data hardly constrain a kind of deviation more than its prior."""
    _, factor = scatter.posterior(scatter.scale / scatter.caution)
    # part of each deviation that is known from the data rather than from the prior
    known = 1 - factor.variances()[scatter.index] / scatter.scale[scatter.kind] ** 2
    determined = np.bincount(scatter.kind, known)
    if (determined < LEAST_DETERMINED).any():
        worst = scatter.kinds[int(np.argmin(determined))]
        n = len(scatter.kind) // len(scatter.kinds)
        drifts = model.time is not None
        raise DegenerateError(
            f"the scatter of {worst!r} is not determined: {n} exposures are no more than the "
            f"linear terms{' and their drift' if drifts else ''} absorb",
            where="exposures",
            do="give more exposures, or "
            + (
                "drop the drift (model.tdd)"
                if drifts
                else "calibrate matched stars ([data] in place of [campaign], model.frames = "
                "'shift_rotation_scale')"
            ),
        )


def trend_p_values(values: Float, epoch: Float, breaks: ArrayLike = ()) -> Float:
    """Probability (k,) of lines in time as steep by chance, for each kind of deviation (E, k).

    An F test of a line in each segment against a constant.  Its noise is the scatter of the
    exposures about the lines, which has all noise of the deviations.  `breaks` are the dates at
    which segments begin; 1 where there are too few exposures.
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
    left = (bent**2).sum(axis=0)
    gain = np.maximum((flat**2).sum(axis=0) - left, 0.0)
    ratio = np.divide(gain / lines.shape[1], left / free, out=np.zeros_like(gain), where=left > 0)
    return np.asarray(f_sf(ratio, lines.shape[1], free))
