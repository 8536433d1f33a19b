"""Estimate the discrepancy between a solution and the truth from its residuals in one pass.

The discrepancy is structure that the model omits, and deviations of exposures. Errors that a
star of the catalogue has in all of its exposures are estimated as well (`shared_stars`). The sizes
of all of these are marginalised, with the priors in `bayesdist.diagnose.correlated.priors`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.diagnose.correlated.deviations import linear_deviations
from bayesdist.diagnose.correlated.exposure_fields import detection_scores, exposure_fields
from bayesdist.diagnose.correlated.exposure_time import correlated_hierarchy
from bayesdist.diagnose.correlated.information import (
    CellSums,
    Information,
    cell_sums,
    cells_per_side,
    not_narrower,
    score_excess,
)
from bayesdist.diagnose.correlated.neighbours import (
    NeighbourScores,
    SharedVariance,
    neighbour_scores,
)
from bayesdist.diagnose.correlated.priors import DiscrepancyPriors, StructureFunctions, log_half_t
from bayesdist.diagnose.correlated.result import ChipStructure, Discrepancy, structure_correlation
from bayesdist.diagnose.correlated.structure import Structure, structure_posterior
from bayesdist.diagnose.statistics import EfficientScore
from bayesdist.infer.catalogue.star_covariance import MatchesByStar, influence_by_group
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.exposures.hierarchy import Settling
from bayesdist.infer.solution.solution import Solution, likelihood_of
from bayesdist.infer.stars.likelihood import Likelihood
from bayesdist.infer.stars.loading import opened
from bayesdist.infer.stars.shards import Shards
from bayesdist.infer.stars.stars import Stars, prepare
from bayesdist.model import DistortionModel
from bayesdist.model.grid import cell_index
from bayesdist.utils.arrays import Float, Int

DRAWS = 2000
RESOLVED = 50  # draws of the resolved structure, for the comparison of neighbouring stars
STEPS = 60
RANGE = 300.0
NEGLIGIBLE = 1e-8  # density relative to the maximum
MIN_FREE = 0.1  # smallest fraction of the stars' errors that remains after the fit


@one_thread
def estimate_discrepancy(
    matches: Matches | Shards,
    solution: Solution,
    *,
    rng: np.random.Generator,
    priors: DiscrepancyPriors | None = None,
    parameter_priors: GaussianPriors | None = None,
    sample: Matches | None = None,
    stars: Matches | None = None,
    structure: bool = True,
    exposures: bool = True,
    settling: Settling | None = None,
    n_draws: int = DRAWS,
) -> Discrepancy:
    """Estimate the structure that a solution lacks, with priors on its size.

    The structure is never assumed to be absent.

    Parameters
    ----------
    matches : Matches or Shards
        Data of the solution.
    solution : Posterior or LinearFit
        Solution as sampled or fitted, without transformations.
    rng : numpy.random.Generator
        Source of random numbers.
    priors : DiscrepancyPriors, optional
        Prior medians of the sizes; see `DiscrepancyPriors` for the defaults.
    parameter_priors : GaussianPriors, optional
        Priors of the solution's parameters; flat by default.
    sample : Matches, optional
        The matches or a part of them, in memory, to estimate structure finer than the functions
        from neighbouring stars.  If None, that structure is not constrained.
    stars : Matches, optional
        All matches, in memory.  If given, errors that are common to the matches of a star, or of a
        tight group of stars, are estimated, and exposures without separate frames are
        distinguished.
    structure : bool
        False to omit structure beyond the model, if look-up tables were fitted to it.
    exposures : bool
        False to omit linear deviations of single exposures, if a hierarchy of them was fitted.
    settling : Settling, optional
        Transformation of the shifts of single chips that was applied after sampling.
    n_draws : int
        Number n of draws.

    Returns
    -------
    Discrepancy

    Raises
    ------
    InputError
        If the solution is a transformed view of another solution.
    """
    model, likelihood = solution.model, likelihood_of(solution)
    priors = priors or DiscrepancyPriors()
    several = stars is not None and len(stars.exposure_names) > 1
    apart = exposures and several and model.frames == "none"
    if stars is not None and apart:
        sums = _by_exposure(stars, likelihood, model)
    else:
        with opened(model, matches) as shards:
            sums = shards.sum(cell_sums, likelihood, cells_per_side(len(shards.groups)))
    mean = likelihood.theta
    working = Information(model, mean, sums, parameter_priors or GaussianPriors.none(model))
    pixel = model.pixel_size(mean)
    repeated = None
    code = None if stars is None else stars.error_codes
    if stars is not None and code is not None:
        repeated = shared_stars(stars, code, likelihood, model, priors.star * pixel)
    information = replace(working, excess=score_excess(working))
    if stars is not None and repeated is not None:
        excess = repeated.repetition
        if apart:
            by_star = _by_exposure(stars, likelihood, model, excess)
        else:
            prepared, order = prepare(model, stars)
            by_star = cell_sums(prepared, likelihood, sums.side, excess[order])
        information = replace(information, sums=by_star)
    chips = range(len(model.chips)) if structure else ()
    near = {} if sample is None or not structure else neighbour_scores(sample, likelihood, model)
    structures, theta, facts = _structures(
        information, working, chips, near, priors, pixel, n_draws, rng
    )
    linear = linear_deviations(information, working, priors, n_draws, rng, exposures=exposures)
    if linear is not None and parameter_priors is not None and model.frames != "none":
        dates = _dates_of_exposures(working)
        correlation = correlated_hierarchy(
            model, mean, working.covariance, parameter_priors, dates, n_draws, rng
        )
        if correlation is not None:
            linear = replace(
                linear, theta=linear.theta + correlation[0], correlation_time=correlation[1]
            )
    near_stars = stars if stars is not None else sample
    detections = None
    if near_stars is not None and len(near_stars.exposure_names) > 1:
        prepared, order = prepare(model, near_stars)
        shared = near_stars.error_codes
        codes = np.arange(len(order)) if shared is None else shared[order]
        detections = detection_scores(
            model, prepared, likelihood, near_stars.exposure[order], codes
        )
    fields = exposure_fields(information, working, detections, priors, n_draws, rng)
    formal, noise = working.covariance, working.squared_scores().by_evidence
    if repeated is not None:
        noise = noise + repeated.covariance(model, mean, formal)
        facts["star_rms"] = repeated.rms
    noise, ratio = not_narrower(noise, formal)
    if settling is not None:
        formal, noise = (settling.mean(settling.mean(c).T).T for c in (formal, noise))
        theta = settling.mean(theta)
        if linear is not None:
            linear = replace(linear, theta=settling.mean(linear.theta))
        if fields is not None:
            fields = replace(fields, theta=settling.mean(fields.theta))
    facts |= {"unit": model.unit, "noise_ratio": ratio}
    facts["structure_correlation"] = structure_correlation(model, structures, theta)
    if linear is not None:
        facts |= linear.facts
        if linear.outlying:
            names = model.exposures
            if stars is not None and model.frames == "none":
                names = stars.exposure_names
            facts["exposures_outlying"] = [names[code] for code in linear.outlying]
    if fields is not None:
        facts["exposure_fields"] = fields.facts(model.chips[0].size)
    return Discrepancy(model, mean, formal, noise, structures, theta, linear, facts, fields)


def _dates_of_exposures(information: Information) -> Float:
    """Dates (E,) of the exposures of a model, decimal years; NaN for exposures without stars."""
    groups = information.sums.groups
    out = np.full(len(information.model.exposures), np.nan)
    out[groups.exposure] = groups.epoch
    return out


def _by_exposure(
    stars: Matches, likelihood: Likelihood, model: DistortionModel, excess: Float | None = None
) -> CellSums:
    """Sums with separate groups for exposures that have no separate frames.

    For `excess` (N,), in the order of the matches, see `cell_sums`.
    """
    side = cells_per_side(len(stars.exposure_names) * len(model.chips))
    parts = []
    for code in range(len(stars.exposure_names)):
        rows = np.flatnonzero(stars.exposure == code)
        if rows.size:
            prepared, order = prepare(model, stars.select(rows))
            exposure_excess = None if excess is None else excess[rows][order]
            part = cell_sums(prepared, likelihood, side, exposure_excess)
            of = np.full(len(part.groups), code)
            parts.append(replace(part, groups=replace(part.groups, exposure=of)))
    return reduce(add, parts)


def _structures(
    information: Information,
    working: Information,
    chips: Sequence[int],
    neighbours: Mapping[int, NeighbourScores],
    priors: DiscrepancyPriors,
    pixel: float,
    n: int,
    rng: np.random.Generator,
) -> tuple[dict[int, ChipStructure], Float, dict[str, object]]:
    """Structure of chips (by code), its effect on the parameters, and its sizes for summaries."""
    model, sums = working.model, working.sums
    stars = sums.position[:, :, 0].sum(axis=1)
    theta, out, rows = np.zeros((n, model.n_params)), {}, []
    for code in chips:
        chip = model.chips[code]
        functions = StructureFunctions.for_stars(model.order, chip.size, int(stars[code]))
        chip_waves = ChipStructure(functions, functions.finer_waves(rng), np.empty(0))
        S, crossed, responses, score = _along_axes(information, working, chip_waves, code)
        efficient = [
            EfficientScore.of(information.covariance, information.score, *axis)
            for axis in zip(crossed, S, score, strict=True)
        ]
        posterior = structure_posterior(
            [[functions]] * 2,
            [axis_score.information for axis_score in efficient],
            [axis_score.score for axis_score in efficient],
            noise=_star_error(information, code),
            higher_order=priors.higher_order * pixel,
            structure=priors.structure * pixel,
            pairs=(None, None)
            if code not in neighbours
            else partial(_finer_evidence, neighbours[code], working, responses, code, rng),
        )
        coefficients = posterior.draws(n, rng, [[chip_waves.waves]] * 2)
        chip_structure = replace(chip_waves, coefficients=np.stack(coefficients, axis=1))
        for a in (0, 1):
            # the fit absorbs structure into polynomials, so that its error has the opposite sign
            theta -= chip_structure.coefficients[:, a] @ (working.covariance @ responses[a]).T
        rows += chip_structure.sizes(chip, posterior.length)
        out[chip.number] = chip_structure
    return out, theta, {"structure": rows}


def _finer_evidence(
    near: NeighbourScores,
    working: Information,
    taken: Sequence[Float],
    code: int,
    rng: np.random.Generator,
    structure: Structure,
) -> tuple[SharedVariance | None, SharedVariance | None]:
    """Evidence of neighbouring stars for structure finer than the functions of a chip.

    `structure` is the posterior of the resolved structure.  `taken` (D, functions), for each axis,
    is the information between the functions and the parameters of the fit, which has absorbed a
    part.
    """
    model, (functions,) = working.model, structure.functions[0]
    phi = model.basis(model.chips[code].number).evaluate_scaled(near.X, near.Y)
    values = functions.evaluate(near.X, near.Y)
    drawn = structure.draws(RESOLVED, rng)
    n_resolved = functions.n_known
    absorbed = np.zeros((RESOLVED, model.n_params))
    for z, t in zip(drawn, taken, strict=True):
        absorbed += z @ (working.covariance @ t[:, :n_resolved]).T
    resolved = np.empty((RESOLVED, len(phi), 2))
    for a in (0, 1):
        columns = model.coefficient_slice(model.chips[code].number, a)
        resolved[..., a] = drawn[a] @ values.T - absorbed[:, columns] @ phi.T
    return near.shared_variances(resolved)


def _star_error(information: Information, chip: int) -> float:
    """Typical error of a star per axis."""
    rows = information.sums.groups.chip == chip
    n, uu, vv = information.sums.sums[rows][:, :, [0, 3, 5]].sum(axis=(0, 1))
    return float(np.sqrt(2 * n / (uu + vv))) if uu + vv > 0 else 1.0


def _along_axes(
    information: Information, working: Information, structure: ChipStructure, chip: int
) -> tuple[list[Float], list[Float], list[Float], list[Float]]:
    """Information and score of the functions on u and v, and their information with the parameters.

    The latter is returned for the flattened likelihood and for the working one, for which it
    includes the finer waves.
    """
    model, side = working.model, working.sums.side
    m, D = structure.functions.n_known, model.n_params
    weight, score = np.zeros((2, side * side)), np.zeros((2, side * side))
    used, X, Y = working.sums.centres(chip)
    all_values = structure.evaluate(X, Y)
    B = all_values[:, :m]
    crossed, by_working = ([np.zeros((D, n)) for _ in "uv"] for n in (m, all_values.shape[1]))
    row = np.full(side * side, -1)
    row[used] = np.arange(len(used))
    for source, into, values in ((information, crossed, B), (working, by_working, all_values)):
        for cells in source.groups():
            if cells.chip != chip:
                continue
            at = row[cell_index(cells.X, cells.Y, (side, side))]
            values_at, M = values[at], cells.frame
            turned = np.einsum("cab,bd->cad", cells.curvature, M)
            for a in (0, 1):
                block = np.stack(
                    [(cells.phi * turned[:, b, a, None]).T @ values_at for b in (0, 1)]
                )
                into[a][cells.columns] += np.einsum("akm,akq->mq", cells.derivative, block)
                if source is information:
                    weight[a, at] += np.einsum("b,cb->c", M[:, a], turned[:, :, a])
                    score[a, at] += cells.score @ M[:, a]
    n = len(used)
    S = [B.T @ (weight[a, :n, None] * B) for a in (0, 1)]
    return S, crossed, by_working, [B.T @ score[a, :n] for a in (0, 1)]


@dataclass(frozen=True, eq=False)
class SharedStars:
    """Errors that stars of the catalogue have in all of their matches."""

    rms: float  # per star and axis, in the unit of u and v; 0 if no star is matched twice
    # (N,) factor, in the order of the table, by which the matches of a star determine the structure
    # at its position less well than matches of different stars
    repetition: Float
    stars: Stars
    code: Int  # (N,) star of each match, in the order of `stars`
    curvature: Float  # (3, N) minus the second derivatives uu, uv, vv of the log-likelihood

    def covariance(self, model: DistortionModel, theta: Float, formal: Float) -> Float:
        """Covariance (D, D) in excess of that due to independent errors of the same size.

        `formal` (D, D) is the covariance of the parameters from their likelihood.
        """
        D = model.n_distortion  # frames change according to their correlation with these
        uu, uv, vv = self.curvature
        unit_weights = np.ones(len(self.code))
        sums = MatchesByStar.of(self.stars, self.code, np.stack([uu, vv]), [unit_weights], uv)
        gradient = influence_by_group(model, theta, self.stars.groups, None, D)
        alike = [np.ones((int(self.code.max()) + 1, 2))]
        shared = sums.shared(gradient, alike)[0] - sums.independent(gradient, alike)
        by_scores = formal[:, :D]
        extra = self.rms**2 * by_scores @ shared @ by_scores.T
        return np.asarray((extra + extra.T) / 2)


def shared_stars(
    table: Matches, code: Int, likelihood: Likelihood, model: DistortionModel, median: float
) -> SharedStars | None:
    """Size of the errors that stars have in all of their matches.

    None if stars have one match each.

    The likelihood includes the variance 1 / h_i of each match, from quoted errors and jitter, of
    which the shared error is a part.  The summed score g of a star, with matches that share a
    variance w^2, then has the variance h (1 + w^2 k), where h is the sum of the h_i and k = h - sum
    h_i^2 / h, so that

        log p(w) = sum over stars and axes of [g^2 / h w^2 k / (1 + w^2 k) - log(1 + w^2 k)] / 2

    Stars with a single match are left out because k is 0.  `code` (N,) is the star of each match,
    or the tight group of stars; `median` is that of the half-Cauchy prior of w, in the unit of u
    and v.
    """
    stars, order = prepare(model, table)
    code = np.unique(code[order], return_inverse=True)[1]
    n_matches = np.bincount(code)
    repeated = n_matches > 1
    if repeated.sum() < 2:
        return None
    g_u, g_v, h_uu, h_uv, h_vv = likelihood.scores(stars)
    good = (h_uu > 0) & (h_vv > 0)
    # correction for the part of the stars' errors that the fit has absorbed
    free = 1 - min(model.n_params / (2 * len(repeated)), 1 - MIN_FREE)
    squares, k_of_stars = [], []  # squared scores over curvature, (n_stars,), and k of each star
    for g, h in ((g_u, h_uu), (g_v, h_vv)):
        top, bottom, sums = (
            np.bincount(code[good], w[good], minlength=len(repeated)) for w in (g, h, h**2)
        )
        bottom = np.maximum(bottom, 1e-300)
        squares.append(top**2 / bottom / free)
        k_of_stars.append(np.maximum(bottom - sums / bottom, 0.0))
    square, k = (
        np.concatenate([z[repeated] for z in per_axis]) for per_axis in (squares, k_of_stars)
    )
    low, high = median / RANGE, median * RANGE
    # second pass where the density is: many stars determine the size to a few per cent
    for _ in range(2):
        size = np.geomspace(low, high, STEPS)
        widening = size[:, None] ** 2 * k
        log_density = log_half_t(size, median) + 0.5 * (
            square * widening / (1 + widening) - np.log1p(widening)
        ).sum(axis=1)
        weight = np.exp(log_density - log_density.max())
        likely = np.flatnonzero(weight > NEGLIGIBLE)
        low, high = size[max(likely[0] - 1, 0)], size[min(likely[-1] + 1, STEPS - 1)]
    variance = float(weight @ size**2 / weight.sum())
    repetition = np.empty(len(order))
    repetition[order] = (1 + variance * np.mean(k_of_stars, axis=0))[code]
    curvature = np.stack([h_uu, h_uv, h_vv]) * good
    return SharedStars(float(np.sqrt(variance)), repetition, stars, code, curvature)
