"""Everything that moves a position: a solution, and terms that are independent of each other.

Errors that its likelihood does not know of spread the draws of a solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import solve_triangular

from bayesdist.assess.budget.budget import ErrorBudget, budget_of
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors, generators
from bayesdist.assess.terms.correlated import Deviations, FieldsOfExposures, StructureErrors
from bayesdist.assess.terms.forms import ErrorTerm, Image
from bayesdist.assess.terms.given import Centroids, UserTerm
from bayesdist.assess.terms.local import LocalErrors, table_of
from bayesdist.assess.terms.parameters import ExposureVariation, catalogue_terms
from bayesdist.assess.terms.solution import SolutionErrors
from bayesdist.assess.units import pixel_scale_of
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import InputError, required
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.catalogue.star_errors import StarCovariance
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
        Independent of the solution and of each other, in its unit.
    aligned : bool
        Whether the star lies in a new exposure whose shift and rotation the observer fits: no frame
        of the solution is in the error then, and what a shift and a rotation of all chips together
        take up is no error.  Terms that are no polynomials stay as they are.
    """

    solution: SolutionErrors
    terms: tuple[ErrorTerm, ...] = ()
    aligned: bool = False

    @property
    def of_new_exposure(self) -> bool:
        """True if the star lies in a new exposure, which deviates as those at hand scatter."""
        return self.aligned and any(isinstance(term, ExposureVariation) for term in self.terms)

    @one_thread
    def drawn(self, n: int, rng: Random) -> DrawnErrors:
        """Draws of all errors.

        A star is taken to lie in an exposure chosen at random, for each draw, among those whose
        frame was fitted, and its error is given along the axes of the polynomials.

        Parameters
        ----------
        n : int
        rng : int or numpy.random.Generator

        Raises
        ------
        InputError
            For fewer than two draws, or more than fit into memory.
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
        """Draws of all errors, which know how to make further ones."""
        one = self.solution.draw(n, rng)
        solution, fitted = self.solution.solution, self.solution.fitted_exposures
        image = Image()
        if self.aligned:
            image = Image(aligned_by=np.asarray(solution.mean, float))
        elif fitted:
            image = Image(rng.integers(fitted[0], len(solution.model.exposures), size=n))
        seed = int(rng.integers(2**63))
        draws = [
            term.draw(n, own)
            for term, own in zip(self.terms, generators(self.terms, seed), strict=True)
        ]
        terms = (self.solution, *self.terms)
        further = partial(self._further, seed)
        return DrawnErrors(solution, terms, (one, *draws), image, n, seed, further)

    def _further(self, seed: int, n: int, number: int) -> DrawnErrors:
        """Further draws beside those of a seed, another set for each number from 1 on."""
        return self._drawn(n, np.random.default_rng([seed, number]))

    def with_terms(self, *terms: ErrorTerm) -> ErrorModel:
        """Error model with more terms; errors of centroids replace those that were there."""
        known = self.terms
        if any(isinstance(term, Centroids) for term in terms):
            known = tuple(term for term in known if not isinstance(term, Centroids))
        return replace(self, terms=(*known, *terms))

    def structure_sigma(self, domain: EvaluationDomain) -> Float | None:
        """Standard deviations (N, 2) of what the model leaves out; None where nothing is left."""
        for term in self.terms:
            if isinstance(term, StructureErrors) and term.left:
                return term.sigma(domain)
        return None

    def local_tables(self, grid: tuple[int, int], epoch: float | None) -> tuple[LookupTable, ...]:
        """Errors that belong to positions on the detector, as a table of each chip.

        Parameters
        ----------
        grid : tuple of int
            Points on x and y of each chip.
        epoch : float or None
            Decimal years.
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
        """The error budget of positions, or of their differences.

        Parameters
        ----------
        domain : EvaluationDomain
        n : int
            Draws.
        rng : int or numpy.random.Generator
        """
        return budget_of(self.drawn(n, rng), domain)


def error_model(
    solution: Solution,
    terms: Sequence[ErrorTerm] = (),
    *,
    aligned: bool = False,
    pixel_scale: float | None = None,
) -> ErrorModel:
    """The error model of a solution by itself, of which residuals say nothing.

    Parameters
    ----------
    solution : LinearFit or Posterior
    terms : sequence of ErrorTerm
        Other errors.  A `SolutionErrors` among them says what of the solution's errors is shown by
        itself.
    aligned : bool
        As of `ErrorModel`.
    pixel_scale : float, optional
        Size of one pixel in mas; `pixel_scale_of` the solution by default.

    Raises
    ------
    InputError
        For a term whose unit needs a pixel scale that is not known.
    """
    if pixel_scale is None:
        pixel_scale = pixel_scale_of(solution)
    errors, others = SolutionErrors(solution), list[ErrorTerm]()
    for term in terms:
        if isinstance(term, SolutionErrors):
            errors = replace(term, solution=solution)
        elif isinstance(term, UserTerm):
            others.append(term.in_unit(solution.model.unit, pixel_scale))
        else:
            others.append(term)
    if not any(isinstance(term, Centroids) for term in others):
        others.append(Centroids(None))  # a domain that names a magnitude asks for it
    return ErrorModel(errors, tuple(others), aligned)


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
    """The error model of a posterior, with what residuals say of it.

    `posterior`: as it was sampled. `diagnostics`: its correlated errors, and what errors of the
    catalogue do, count in. `terms`: other errors. `hierarchy`: the fit of a hierarchy of exposures,
    whose covariance has no noise of draws. `catalogue`: name of the file that states the
    catalogue's errors. `single`: whether the star lies in a single exposure, whose deviation
    counts; else in the mean. `frames`: whether errors of the exposures' frames follow the
    correlated errors. `structure_left`: whether what the model leaves out at a position counts; not
    where errors of look-up tables stand for it. `aligned`, `pixel_scale`, InputError: as of
    `error_model`.
    """
    measured: list[ErrorTerm] = []
    correlated = diagnostics.correlated
    if correlated is not None and correlated.structure:
        measured.append(StructureErrors(correlated, frames, structure_left))
    if correlated is not None and correlated.linear is not None:
        measured.append(Deviations(correlated, single, frames))
    if correlated is not None and correlated.fields is not None:
        # of a campaign positions are assessed in a new exposure
        measured.append(FieldsOfExposures(correlated, single or aligned, frames))
    own = SolutionErrors(with_diagnosed_errors(posterior, diagnostics, hierarchy, noise_alone=True))
    if diagnostics.catalogue is not None:
        of_catalogue = catalogue_terms(posterior, diagnostics.catalogue, catalogue)
        own = replace(own, without=posterior, catalogue=of_catalogue)
    found = error_model(posterior, terms, aligned=aligned, pixel_scale=pixel_scale)
    return replace(found, solution=own, terms=(*measured, *found.terms))


def with_shared_stars(posterior: Posterior, fit: LinearFit, stars: StarCovariance) -> Posterior:
    """A posterior whose draws are spread by what the errors of the catalogue add.

    The linear map that turns the covariance of the fit into the larger one is applied to the
    deviations of the draws, so that they keep their shape: no noise could be added, as errors that
    the fit takes for independent may cancel.  Where the posterior is as much wider than the fit as
    its jitter says, so is the covariance that the map begins with.

    `fit`: that `stars` was computed for. The result comes with other draws of theta and the same
    mean; all else is as it was.
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
    """Posterior whose draws are spread by all that diagnostics know of errors of its parameters.

    So it is exported and shown; `posterior` is as it was sampled.  `hierarchy` is the fit of a
    hierarchy of exposures, whose covariance has no noise of draws.  `noise_alone` counts, of the
    correlated errors, those of the stars as they scatter: what else there is stands in terms of its
    own.
    """
    if diagnostics is None:
        return posterior
    solution, stars, found = posterior, diagnostics.catalogue, diagnostics.correlated
    if stars is not None:
        needed = required(hierarchy, "errors of the catalogue need a joint fit")
        solution = with_shared_stars(posterior, needed, stars)
    if found is None:
        return solution
    cov = found.noise if noise_alone else found.covariance
    if hierarchy is None:
        return solution.mapped(recolouring(found.formal, cov))
    before = _covariance(posterior, hierarchy)
    if stars is not None:
        before = before + stars.extra
    # frames follow as they are correlated with polynomials and drift
    D = found.model.n_distortion
    follow = np.asarray(np.linalg.solve(before[:D, :D], before[:D]).T, float)
    more = _least(before, follow, (cov - found.formal)[:D, :D])
    return solution.mapped(recolouring(before, before + more))


def _covariance(posterior: Posterior, fit: LinearFit) -> Float:
    """Covariance (D, D) of a posterior without the noise of its draws."""
    formal = np.asarray(fit.cov, float)
    wider = float(np.trace(np.linalg.solve(formal, posterior.cov))) / len(formal)
    return wider * formal


def _least(before: Float, follow: Float, change: Float) -> Float:
    """Addition to a covariance (D, D), limited so that no direction loses more than half of it.

    It is that of some parameters, `change` (d, d), which the others `follow` (D, d).
    """
    root = scaled_cholesky(before)
    basis, white = np.linalg.qr(solve_triangular(root, follow, lower=True))
    inner = white @ change @ white.T
    values, vectors = np.linalg.eigh((inner + inner.T) / 2)
    turned = root @ (basis @ vectors)
    return np.asarray((turned * np.maximum(values, -0.5)) @ turned.T)
