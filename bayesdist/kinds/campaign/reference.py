"""Drift and look-up tables that a campaign takes over from the run of a reference filter.

In Kozhurina-Platais et al. (2015, section 4.4.4), the time dependence is derived in one filter and
applied to all, for example to a filter with few exposures.  Rates and steps are transformed to the
reference gauge, so that the orientations of the catalogues and of the first exposures do not
matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.config.fit import TablesBlock
from bayesdist.app.config.run import TABLES, rates_file, tables_file
from bayesdist.app.parts import converged_posterior, read_tables
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import GaussianPriors
from bayesdist.infer.equations.scaled import scaled_inverse, unit_diagonal
from bayesdist.infer.solution.solution import DerivedSolution, Solution
from bayesdist.infer.solution.transforms import reference_gauge, without_frames
from bayesdist.kinds.campaign.linear_terms import with_gap
from bayesdist.model import Chip, DistortionModel, LookupTable
from bayesdist.model.alignment import turned, turned_model
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Random, generator_of


@dataclass(frozen=True, eq=False)
class SharedDrift(DerivedSolution):
    """Solution without frames that has the drift of another solution."""

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution  # original solution, without frames
    reference: Solution  # solution that provides the drift, in its reference gauge
    gain: Float  # derivative (n_polynomial, n_tdd) of the polynomials with respect to the drift
    matrix: Float  # matrix (n_tdd, D') from the parameters of `reference` to this drift

    def draws(self, n: int, rng: Random) -> Float:
        """Draws (n, D) of the source, with the drift replaced by draws of the reference's drift."""
        generator = generator_of(rng)
        theta = np.array(self.source.draws(n, generator), float)
        drift = np.asarray(self.reference.draws(n, generator), float) @ self.matrix.T
        k = self.model.n_polynomial
        theta[:, :k] += (drift - theta[:, k:]) @ self.gain.T
        theta[:, k:] = drift
        return theta


def with_drift_of(
    solution: Solution, reference: Solution, *, chip: int = 2, formal: Solution | None = None
) -> SharedDrift:
    """Replace the drift of a solution by that of a reference, and adapt its polynomials.

    The polynomials are those of the Gaussian posterior, conditional on the drift of the reference.
    They do not depend on the drift that the solution had, whether from data or from a prior; the
    information of its data about the drift is not used.

    Parameters
    ----------
    solution : Solution
        Solution with drift. Its data or priors must determine all drift terms.
    reference : Solution
        Solution that provides the drift.
    chip : int
        Number of the reference chip.
    formal : Solution, optional
        Solution with the covariance from which the dependence of the polynomials on the drift is
        computed, such as the linear fit of a posterior, since a covariance from a few thousand
        draws is noisy. By default `solution`.

    Returns
    -------
    SharedDrift
        Solution without frames.

    Raises
    ------
    InputError
        If the solutions have different chips, units or reference dates, or one has no drift.
    DegenerateError
        If the covariance of the solution's drift is singular.
    """
    bare = without_frames(solution)
    model = bare.model
    gauge = reference_gauge(solution, chip).gauge
    view, matrix = _in_gauge(reference, model, chip, gauge.rotation)
    k = model.n_polynomial
    cov = np.asarray(bare.cov, float)
    if not (np.diag(cov)[k:] > 0).all():
        raise DegenerateError(
            "the solution's drift has no error", where="model.tdd", do="fit it, or give it a prior"
        )
    exact = cov if formal is None else np.asarray(without_frames(formal).cov, float)
    gain = exact[:k, k:] @ scaled_inverse(exact[k:, k:])
    drift = matrix @ np.asarray(view.mean, float)
    spread = matrix @ np.asarray(view.cov, float) @ matrix.T
    mean = np.array(bare.mean, float)
    mean[:k] += gain @ (drift - mean[k:])
    mean[k:] = drift
    total = np.empty_like(cov)
    cross = gain @ cov[k:, :k]
    total[:k, :k] = cov[:k, :k] - cross - cross.T + gain @ (spread + cov[k:, k:]) @ gain.T
    total[:k, k:] = gain @ spread
    total[k:, :k] = total[:k, k:].T
    total[k:, k:] = spread
    return SharedDrift(model, mean, (total + total.T) / 2, bare, view, gain, matrix)


def drift_priors(
    reference: Solution, model: DistortionModel, *, chip: int = 2
) -> dict[str, tuple[float, float]]:
    """Independent priors (mean, sigma) on the rates and steps of a model, by parameter name.

    They are derived from the drift of a reference solution; `chip` is the number of the reference
    chip.

    The polynomials of the model must be along the axes of the reference chip, as in
    `held_in_reference`.  A remaining rotation of about 1e-5, due to the error of the first
    exposure, changes a rate by only 1e-5 of another rate.

    The covariance S of the reference's drift has strong correlations, because chips drift together.
    The independent priors have the variances k diag(S), with k the largest eigenvalue of the
    correlation matrix.  They are not tighter than S in any direction (k diag(S) - S is positive
    semidefinite), so that errors derived from them are too large rather than too small.

    Raises InputError if the models have different chips, units or reference dates, or no drift.
    """
    view, matrix = _in_gauge(reference, model, chip, 0.0)
    mean = matrix @ np.asarray(view.mean, float)
    cov = matrix @ np.asarray(view.cov, float) @ matrix.T
    correlation, sigma = unit_diagonal(cov)
    largest = float(np.linalg.eigvalsh(correlation)[-1])
    names = model.names[model.n_polynomial : model.n_distortion]
    pairs = zip(mean.tolist(), (np.sqrt(largest) * sigma).tolist(), strict=True)
    return dict(zip(names, pairs, strict=True))


def held_tables(block: TablesBlock, chips: tuple[Chip, ...], base: Path) -> tuple[LookupTable, ...]:
    """Look-up tables of the detector that are held fixed; empty if the configuration names none.

    Raises InputError if any of `chips` has no table.
    """
    if block.detector is None:
        return ()
    path = tables_file(base / block.detector)
    if path.name == TABLES:
        stored = read_tables(path, do="run its stage 'fit' again").tables
        tables = tuple(table for table in stored if not table.filter)
    else:
        tables = open_document(path).tables()
    have = {table.chip for table in tables}
    missing = [chip.name for chip in chips if chip.number not in have]
    if missing:
        raise InputError(
            f"there is no table of the detector for chip {missing[0]}",
            where=str(path),
            do="name the run or the file of tables of this detector in tables.detector",
        )
    numbers = {chip.number for chip in chips}
    ours = (table for table in tables if table.chip in numbers)
    return tuple(sorted(ours, key=lambda table: table.chip))


def rate_priors(config: Config, model: DistortionModel, base: Path) -> GaussianPriors | None:
    """Priors on the drift of a model from the posterior of another run; None if it is free."""
    tdd, chip = config.model.tdd, config.chips()[0].number
    if tdd is None or config.has_free_rates:
        return None
    path = rates_file(base / tdd.rates)
    posterior = converged_posterior(path, "its rates are used")
    try:
        named = drift_priors(posterior, model, chip=chip)
    except InputError as error:
        raise InputError(error.cause, where=str(path.parent), do=error.do) from error
    return GaussianPriors.of(model, named)


def rehearse_references(config: Config, unit: str, base: Path) -> None:
    """Read everything that a run takes over from other runs, without fitting."""
    chips = config.chips()
    held_tables(config.tables, chips, base)
    if not config.has_free_rates:
        model = with_gap(DistortionModel(config.model.order, chips, unit, config.time()))
        rate_priors(config, model, base)


def _in_gauge(
    reference: Solution, model: DistortionModel, chip: int, rotation: float
) -> tuple[Solution, Float]:
    """Reference in its gauge, and the matrix (n_tdd, D') from its parameters to a model's drift.

    `rotation` (radians) is that of the transformation from the model to the gauge.
    """
    _require_alike(reference.model, model)
    view = reference_gauge(reference, chip)
    # rotate back; drifts of terms that do not drift in the model are dropped
    linear = turned(view.model, np.eye(view.model.n_params), np.exp(-1j * rotation), 0.0).T
    names = turned_model(view.model).names
    wanted = model.names[model.n_polynomial : model.n_distortion]
    return view, linear[[names.index(name) for name in wanted]]


def _require_alike(reference: DistortionModel, model: DistortionModel) -> None:
    """Raise InputError if the models differ in chips, units, drifting terms or dates."""
    location = "model.tdd"
    if reference.time is None or model.time is None:
        raise InputError(
            "the reference solution does not drift"
            if reference.time is None
            else "the model does not drift",
            where=location,
            do="give both the same [model.tdd]",
        )
    missing = [term for term in model.time.terms if term not in reference.time.terms]
    if missing:
        raise InputError(
            f"the term {missing[0]} does not drift in the reference solution",
            where=f"{location}.terms",
            do="configure both in the same way",
        )
    for attribute, mine, theirs in (
        ("chips", model.chips, reference.chips),
        ("units", model.unit, reference.unit),
        ("reference dates", model.time.epoch0, reference.time.epoch0),
        ("breaks", model.time.breaks, reference.time.breaks),
    ):
        if mine != theirs:
            details = "" if attribute == "chips" else f": {mine} and, in the reference, {theirs}"
            raise InputError(
                f"the {attribute} are not those of the reference solution{details}",
                where=location,
                do="configure both in the same way",
            )
