"""Model of all position errors: those of the solution, and independent error terms.

Errors that the likelihood does not include are added by widening the draws of the solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import solve_triangular

from bayesdist.assess.budget import ErrorBudget, budget_of
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors, generators
from bayesdist.assess.terms.catalogue import CatalogueSystematics
from bayesdist.assess.terms.correlated import (
    Deviations,
    FieldsOfExposures,
    LocalErrors,
    StructureErrors,
    table_of,
)
from bayesdist.assess.terms.forms import ErrorTerm, Image
from bayesdist.assess.terms.given import Centroids, UserTerm
from bayesdist.assess.terms.parameters import ExposureVariation, SolutionErrors, catalogue_terms
from bayesdist.assess.units import pixel_scale_of
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import InputError, required
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.catalogue.star_covariance import StarCovariance
from bayesdist.infer.equations.scaled import one_thread, recolouring, scaled_cholesky
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import LookupTable
from bayesdist.utils.arrays import Float
from bayesdist.utils.memory import require_memory
from bayesdist.utils.quantities import Random, generator_of


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """All errors of a position: those of the solution, and independent terms.

    Parameters
    ----------
    solution : SolutionErrors
        Errors of the parameters, from draws of a solution.
    terms : tuple of ErrorTerm
        Errors that are independent of the solution and of each other, in the unit of the solution.
    aligned : bool
        True if the star is observed in a new exposure and the observer fits its shift and rotation.
        The errors then exclude the frames of the solution, and the shift and rotation common to all
        chips that this fit absorbs; errors that are independent between stars are unchanged.
    """

    solution: SolutionErrors
    terms: tuple[ErrorTerm, ...] = ()
    aligned: bool = False

    @property
    def of_new_exposure(self) -> bool:
        """True if the star is in a new exposure, which deviates as much as the fitted ones do."""
        return self.aligned and any(isinstance(term, ExposureVariation) for term in self.terms)

    @one_thread
    def drawn(self, n: int, rng: Random) -> DrawnErrors:
        """Draws of all errors.

        For each draw, the star is in an exposure chosen at random among those with a fitted frame.
        Its error is given along the axes of the polynomials.

        Parameters
        ----------
        n : int
            Number of draws, at least 2.
        rng : int or numpy.random.Generator
            Seed or random generator.

        Returns
        -------
        DrawnErrors

        Raises
        ------
        InputError
            If `n` is less than two, or if the draws do not fit into memory.
        """
        if n < 2:
            raise InputError(f"the number of draws is {n}", do="ask for at least 2")
        require_memory(
            8.0 * n * len(self.solution.solution.model.names),
            f"{n} draws of {len(self.solution.solution.model.names)} parameters",
            where="assess.draws",
            do="ask for fewer",
        )
        return self._drawn(n, generator_of(rng))

    def _drawn(self, n: int, rng: np.random.Generator) -> DrawnErrors:
        """Draws of all errors, with a function that makes further ones."""
        solution_draws = self.solution.draw(n, rng)
        solution, fitted = self.solution.solution, self.solution.fitted_exposures
        image = Image()
        if self.aligned:
            image = Image(aligned_by=np.asarray(solution.mean, float))
        elif fitted:
            image = Image(rng.integers(fitted[0], len(solution.model.exposures), size=n))
        seed = int(rng.integers(2**63))
        draws = [
            term.draw(n, term_rng)
            for term, term_rng in zip(self.terms, generators(self.terms, seed), strict=True)
        ]
        terms = (self.solution, *self.terms)
        further = partial(self._further, seed)
        return DrawnErrors(solution, terms, (solution_draws, *draws), image, n, seed, further)

    def _further(self, seed: int, n: int, number: int) -> DrawnErrors:
        """Further draws of the errors with this seed; each `number` from 1 on gives another set."""
        return self._drawn(n, np.random.default_rng([seed, number]))

    def with_terms(self, *terms: ErrorTerm) -> ErrorModel:
        """Error model with more terms; new errors of centroids replace the previous ones."""
        previous = self.terms
        if any(isinstance(term, Centroids) for term in terms):
            previous = tuple(term for term in previous if not isinstance(term, Centroids))
        return replace(self, terms=(*previous, *terms))

    def structure_sigma(self, domain: EvaluationDomain) -> Float | None:
        """Standard deviations (N, 2) of structure that the model omits; None if there is none.

        They are in the unit of u and v of the solution.
        """
        for term in self.terms:
            if isinstance(term, StructureErrors) and term.left:
                return term.sigma(domain)
        return None

    def local_tables(self, grid: tuple[int, int], epoch: float | None) -> tuple[LookupTable, ...]:
        """Tables of the position-dependent errors, one for each chip that has any.

        Parameters
        ----------
        grid : tuple of int
            Number of points along x and y on each chip.
        epoch : float or None
            Decimal years.

        Returns
        -------
        tuple of LookupTable
            Standard deviations of u and v at the grid points, in the unit of the solution.
        """
        model, out = self.solution.solution.model, []
        for chip in model.chips:
            domain = EvaluationDomain.of_chips(model, grid, chips=(chip.number,), epoch=epoch)
            structure = self.structure_sigma(domain)
            parts = [term.sigma(domain) for term in self.terms if isinstance(term, LocalErrors)]
            parts += [] if structure is None else [structure]
            if parts:
                sigma = np.sqrt(sum(part**2 for part in parts)).reshape(grid[1], grid[0], 2)
                out.append(table_of(chip.number, chip.size, sigma))
        return tuple(out)

    def at(self, domain: EvaluationDomain, *, n: int = 4000, rng: Random) -> ErrorBudget:
        """Error budget of positions, or of differences between positions.

        Parameters
        ----------
        domain : EvaluationDomain
            Positions, epoch and magnitude.
        n : int
            Number of draws.
        rng : int or numpy.random.Generator
            Seed or random generator.

        Returns
        -------
        ErrorBudget
            In the unit of u and v.

        Raises
        ------
        InputError
            If `n` is less than two, the epoch is missing, or the domain has a magnitude but no
            errors by magnitude are known.
        """
        return budget_of(self.drawn(n, rng), domain)


def error_model(
    solution: Solution,
    terms: Sequence[ErrorTerm] = (),
    *,
    aligned: bool = False,
    pixel_scale: float | None = None,
) -> ErrorModel:
    """Error model of a solution without anything measured from the residuals.

    Parameters
    ----------
    solution : LinearFit or Posterior
    terms : sequence of ErrorTerm
        Further errors. If one is a `SolutionErrors`, it determines which rows of the budget the
        errors of the solution are split into.
    aligned : bool
        True if the observer fits shift and rotation of the exposure; see `ErrorModel`.
    pixel_scale : float, optional
        Size of one pixel in mas; by default `pixel_scale_of` the solution.

    Returns
    -------
    ErrorModel

    Raises
    ------
    InputError
        If the unit of a term needs the pixel scale and that is unknown.
    """
    if pixel_scale is None:
        pixel_scale = pixel_scale_of(solution)
    errors, other_terms = SolutionErrors(solution), list[ErrorTerm]()
    for term in terms:
        if isinstance(term, SolutionErrors):
            errors = replace(term, solution=solution)
        elif isinstance(term, UserTerm):
            other_terms.append(term.in_unit(solution.model.unit, pixel_scale))
        elif isinstance(term, CatalogueSystematics):
            other_terms += term.in_field(solution, pixel_scale)
        else:
            other_terms.append(term)
    if not any(isinstance(term, Centroids) for term in other_terms):
        other_terms.append(Centroids(None))  # a domain with a magnitude needs this term
    return ErrorModel(errors, tuple(other_terms), aligned)


@one_thread
def diagnosed_error_model(
    posterior: Posterior,
    diagnostics: Diagnostics,
    terms: Sequence[ErrorTerm],
    *,
    hierarchy: LinearFit | None,
    catalogue: str,
    single: bool,
    frames: bool,
    structure_left: bool,
    aligned: bool,
    pixel_scale: float | None,
) -> ErrorModel:
    """Error model of a posterior, including what was measured from the residuals.

    `posterior`: as sampled. `diagnostics`: their correlated errors and effects of catalogue errors
    are included. `terms`: further errors. `hierarchy`: fit of the hierarchy of exposures, which
    gives a covariance without Monte-Carlo noise. `catalogue`: name of the file with the
    catalogue errors. `single`: True if the star is in a single exposure and the deviation of that
    exposure is an error, False for the mean of all exposures. `frames`: True if errors of the
    exposure frames are correlated with the measured errors. `structure_left`: True to include
    structure that the model omits; False if errors of look-up tables represent it.
    `aligned`, `pixel_scale`: see `error_model`, which also raises InputError.
    """
    measured: list[ErrorTerm] = []
    correlated = diagnostics.correlated
    if correlated is not None and correlated.structure:
        ambiguous = (
            diagnostics.shows_structure
            and not any(isinstance(term, CatalogueSystematics) for term in terms)
            # exposures that point elsewhere move structure of the catalogue over the detector
            and posterior.model.frames == "none"
            and not aligned
        )
        measured.append(StructureErrors(correlated, frames, structure_left, ambiguous=ambiguous))
    if correlated is not None and correlated.linear is not None:
        measured.append(Deviations(correlated, single, frames))
    if correlated is not None and correlated.fields is not None:
        # in a campaign, positions are assessed in a new exposure
        measured.append(FieldsOfExposures(correlated, single or aligned, frames))
    solution_errors = SolutionErrors(
        with_diagnosed_errors(posterior, diagnostics, hierarchy, noise_alone=True)
    )
    if diagnostics.catalogue is not None:
        catalogue_errors = catalogue_terms(posterior, diagnostics.catalogue, catalogue)
        solution_errors = replace(solution_errors, without=posterior, catalogue=catalogue_errors)
    stated_errors = error_model(posterior, terms, aligned=aligned, pixel_scale=pixel_scale)
    return replace(stated_errors, solution=solution_errors, terms=(*measured, *stated_errors.terms))


def with_shared_stars(posterior: Posterior, fit: LinearFit, stars: StarCovariance) -> Posterior:
    """Widen the draws of a posterior by the covariance that the catalogue errors contribute.

    The deviations of the draws are multiplied by the matrix that transforms the covariance of the
    fit into the larger one. This preserves the shape of the posterior. Adding noise would be wrong,
    because errors that the fit takes as independent may cancel. If jitter made the posterior wider
    than the fit, the covariance before widening is scaled accordingly.

    `fit`: the fit that `stars` was computed for. Returns a posterior with other draws of theta and
    the same mean; everything else is unchanged.
    """
    before = _covariance(posterior, fit)
    return posterior.mapped(recolouring(before, before + stars.extra))


@one_thread
def with_diagnosed_errors(
    posterior: Posterior,
    diagnostics: Diagnostics | None,
    hierarchy: LinearFit | None = None,
    *,
    noise_alone: bool = False,
) -> Posterior:
    """Widen the draws of a posterior by all errors of its parameters that diagnostics found.

    The result is what is exported and shown; `posterior` is as sampled. `hierarchy` is the fit of a
    hierarchy of exposures, which gives a covariance without Monte-Carlo noise. With `noise_alone`,
    the only correlated errors included are those from the observed scatter of the stars, because
    separate error terms represent the others.
    """
    if diagnostics is None:
        return posterior
    solution, stars, correlated = posterior, diagnostics.catalogue, diagnostics.correlated
    if stars is not None:
        needed = required(hierarchy, "errors of the catalogue need a joint fit")
        solution = with_shared_stars(posterior, needed, stars)
    if correlated is None:
        return solution
    cov = correlated.noise if noise_alone else correlated.covariance
    if hierarchy is None:
        return solution.mapped(recolouring(correlated.formal, cov))
    before = _covariance(posterior, hierarchy)
    if stars is not None:
        before = before + stars.extra
        # the frames change according to their correlation with polynomials and drift
    D = correlated.model.n_distortion
    follow = np.asarray(np.linalg.solve(before[:D, :D], before[:D]).T, float)
    addition = _least(before, follow, (cov - correlated.formal)[:D, :D])
    return solution.mapped(recolouring(before, before + addition))


def _covariance(posterior: Posterior, fit: LinearFit) -> Float:
    """Covariance (D, D) of a posterior without the Monte-Carlo noise of its draws."""
    formal = np.asarray(fit.cov, float)
    wider = float(np.trace(np.linalg.solve(formal, posterior.cov))) / len(formal)
    return wider * formal


def _least(before: Float, follow: Float, change: Float) -> Float:
    """Increment of a covariance (D, D), limited so that no variance falls below half.

    `before`: covariance (D, D). `follow`: regression coefficients (D, d) of all parameters on the
    d parameters with the covariance increment `change` (d, d).
    """
    root = scaled_cholesky(before)
    basis, white = np.linalg.qr(solve_triangular(root, follow, lower=True))
    inner = white @ change @ white.T
    values, vectors = np.linalg.eigh((inner + inner.T) / 2)
    turned = root @ (basis @ vectors)
    return np.asarray((turned * np.maximum(values, -0.5)) @ turned.T)
