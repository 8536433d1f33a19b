"""Solution of a self-calibration: mode and gauge, posterior, and catalogue of the stars.

Later stages restore the solution from its part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from astropy.table import Column, Table
from astropy.units import Unit
from numpy.typing import NDArray

from bayesdist.app.parts import FIT_AGAIN, Part, read_stored_fit
from bayesdist.app.run import Run
from bayesdist.app.stars import ErrorLaw
from bayesdist.app.store.record import write_table
from bayesdist.data import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.data.writing import write_columns
from bayesdist.diagnose.correlated import Discrepancy, DiscrepancyPriors
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.infer import Compute, GaussianPriors, Posterior
from bayesdist.kinds.selfcal.diagnose.eliminated import taken_by_stars
from bayesdist.kinds.selfcal.diagnose.tests import (
    dithered_misfit,
    selfcal_discrepancy,
    selfcal_score_tests,
)
from bayesdist.kinds.selfcal.gauge import fixed_by, gauge_summary, gauge_table, gauge_words
from bayesdist.kinds.selfcal.infer import (
    Gauge,
    SelfCalibrationMode,
    StarCatalogue,
    sample_selfcal,
    star_catalogue,
)
from bayesdist.kinds.selfcal.infer.elimination import Mixture, one_cluster
from bayesdist.kinds.selfcal.infer.gauge import Decision
from bayesdist.kinds.selfcal.infer.mode import gauge_of, mode_at, solve_in_gauge
from bayesdist.kinds.selfcal.inputs import SelfcalInputs
from bayesdist.kinds.selfcal.matching import (
    FirstSolution,
    magnitude_errors_of,
    matches_of,
    unused_detections,
)
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float, Int

ARRAYS = ("theta", "stars", "mixture", "held", "n_free", "reference")
RELINEARISED = 3  # number of times a problem is relinearised about a restored solution

SOLUTION, GAUGE = "solution.h5", "gauge.ecsv"

NAMES = ("u", "v", "pm_u", "pm_v", "parallax")
FEW, DOUBTFUL, REFERENCE = 1, 2, 4
FLAGS = {
    FEW: "two detections: one false one would not show",
    DOUBTFUL: "more than a third of the detections are expected to be false",
    REFERENCE: "a reference star: its catalogue position is among its measurements",
}
MIN_MEMBERS = 2 / 3  # expected fraction of true detections below which a star is doubtful
PARQUET_FROM = 100_000  # number of stars above which a Parquet file is written, too


def arrays_of(solution: SelfCalibrationMode, reference: Float) -> dict[str, NDArray[Any]]:
    """Arrays that store a solution; `reference` (D,) is where the constraints were linearised."""
    mixture, decision = solution.mixture, solution.decision
    counts = (0, 0) if decision is None else (decision.n_null, decision.n_open)
    held = np.setdiff1d(np.arange(len(solution.theta)), solution.free)
    return {
        "theta": solution.theta,
        "stars": solution.stars,
        "mixture": np.array([mixture.jitter, mixture.fraction]),
        "held": held if decision is None else decision.held,
        "n_free": np.array(counts),
        "reference": reference,
    }


def load_selfcal(run: Run) -> Run:
    """Run with the fit of an earlier stage, including its solution."""
    folder = run.directory.path
    artefacts = read_stored_fit(folder)
    path = folder / SOLUTION
    arrays = read_arrays(path, "", "a solution of detections", ARRAYS, do=FIT_AGAIN)
    solved = solved_of(run, artefacts["fit"].model, arrays, run.config.resources())
    return run.having(**{**artefacts, "parts": {"solved": solved}})


def solved_of(
    run: Run,
    model: DistortionModel,
    arrays: Mapping[str, NDArray[Any]],
    compute: Compute | None,
) -> SelfCalibrated:
    """Restore the solution that `arrays_of` stored.

    The fit itself uses the restored solution, so that later stages obtain the same one.
    """
    inputs: SelfcalInputs = run.inputs
    first, held = run.part(FirstSolution), arrays["held"].astype(np.int64)
    theta, stars = arrays["theta"], arrays["stars"]
    jitter, fraction = (float(v) for v in arrays["mixture"])
    n_null, n_open = (int(n) for n in arrays["n_free"])
    mixture, constraints = Mixture(jitter, fraction), inputs.known_for(model)
    problem = inputs.problem(model, first.detections, theta, first.theta)
    for _ in range(RELINEARISED):
        problem = problem.at(theta, stars)
    solution = mode_at(
        problem,
        theta,
        stars,
        mixture,
        np.setdiff1d(np.arange(model.n_params), held),
        constraints(arrays["reference"]),
        Decision(n_null, n_open, held),
        compute=compute,
    )
    gauge = gauge_of(problem, theta, constraints(theta), solution)
    fixed, places = fixed_by(gauge, solution, constraints), solution.stars
    contact = inputs.contact(model, first.theta)
    return SelfCalibrated(
        solution,
        gauge,
        fixed,
        gauge_words(gauge, fixed, model, contact),
        gauge_table(gauge, fixed, model),
        matches_of(problem, places, first.detections, inputs, unused_detections(run.match_facts)),
        arrays,
        tuple(constraints.contradictions(theta)),
        inputs.catalog,
        contact,
    )


def fit_selfcal(run: Run) -> Run:
    """Find mode and gauge of a self-calibration together."""
    inputs: SelfcalInputs = run.inputs
    first = run.part(FirstSolution)
    model = first.problem.model
    with one_cluster(inputs.config.resources()) as compute:
        mode = solve_in_gauge(
            first.problem,
            first.theta,
            inputs.known_for(model),
            stars=first.places,
            mixture=first.mixture,
            jitter=inputs.jitter,
            compute=compute,
        )
        solved = solved_of(run, model, arrays_of(mode, first.theta), compute)
    summary = gauge_summary(solved.gauge, solved.fixed, model)
    return run.having(
        fit=mode.solution,
        errors=ErrorLaw(by_magnitude=magnitude_errors_of(solved.mode, solved.matches)),
        priors=GaussianPriors.none(model),
        parts={"solved": solved},
        fit_facts={"selfcal": {**run.match_facts, "gauge": summary}},
    )


def sample_detections(
    run: Run,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Sample the posterior of a self-calibration, with errors in the unit of u, v."""
    return sample_selfcal(
        run.part(SelfCalibrated).mode,
        outliers=run.config.mixture(),
        **run.config.sampler.model_dump(),
        folder=folder,
        progress=progress,
        compute=run.config.resources(),
    )


@dataclass(frozen=True, eq=False)
class SelfCalibrated(Part):
    """Mode of a self-calibration with its gauge and matches."""

    title = "solution of detections"
    applies_errors = True

    mode: SelfCalibrationMode
    gauge: Gauge  # degeneracies of the detections, and the constraints that remove them
    fixed: Mapping[str, str]  # constraint on each property of the solution, by its name
    gauge_words: str  # sentence that states the gauge of the solution
    gauge_table: Table  # one row for each property of the solution
    matches: Matches  # detections matched with their stars
    arrays: Mapping[str, NDArray[Any]]  # from which the solution is restored
    # sentences about constraints that contradict the detections
    contradictions: tuple[str, ...] = ()
    references: ReferenceCatalog | None = None  # reference stars that are also in a catalogue
    # point (u, v) where the tangent plane of the stars touches the sky; None if the sky is flat
    contact: tuple[float, float] | None = None

    # -- bayesdist.diagnose.diagnostics.FittedStars -----------------------------------------------

    def misfits(self) -> tuple[Misfit, ...]:
        """Structure in the residuals of all chips."""
        return (dithered_misfit(self.mode),)

    def absorbed(self, rows: Int) -> Float:
        """Fraction (N,) of the variance of the detections that fitted positions of stars absorb."""
        solved_rows = self.mode.problem.rows
        fraction = np.zeros(max(int(solved_rows.max(initial=-1)), int(rows.max(initial=-1))) + 1)
        fraction[solved_rows] = taken_by_stars(self.mode)
        return fraction[rows]

    def discrepancy(self, *, rng: np.random.Generator, priors: DiscrepancyPriors) -> Discrepancy:
        """Correlated errors beyond the model."""
        return selfcal_discrepancy(self.mode, rng=rng, priors=priors)

    def score_tests(self, stars: Matches) -> tuple[ScoreTest, ...]:
        """Score tests of the residuals, with the stars eliminated."""
        return selfcal_score_tests(self.mode, mag=stars.mag, colour=stars.colour, epoch=stars.epoch)

    # -- bayesdist.app.parts.Part -------------------------------------------------------

    def save(self, folder: Path) -> None:
        """Write the solution and the gauge to the folder of a run."""
        write_arrays(folder / SOLUTION, "", self.arrays)
        write_table(self.gauge_table, folder / GAUGE)

    def placed(self, stars: Matches, model: DistortionModel) -> Matches:
        """Detections matched with the positions of the solved stars."""
        return self.matches

    def gauge_sentence(self) -> str:
        """Sentence that states the gauge of the solution."""
        return self.gauge_words


class StarsFacts(TypedDict):
    """Entry 'stars' of the section 'selfcal' of summary.json."""

    n: int
    unit: str  # of the radii
    epoch: float | None  # decimal years; None if stars do not move
    n_two_detections: int
    n_doubtful: int
    n_reference: int
    radius_median: float  # errors of both axes together, including those of the distortion
    radius_own_median: float  # from the detections of the star alone


def write_stars(
    folder: Path,
    solved: SelfCalibrated,
    correlated: Discrepancy | None,
    notes: Mapping[str, Any],
    compute: Compute,
) -> StarsFacts:
    """Write stars.ecsv and, if there are many stars, stars.parquet.

    Parameters
    ----------
    folder : Path
    solved : SelfCalibrated
    correlated : Discrepancy or None
        Adds its covariance of the parameters, which all stars have in common.
    notes : mapping
        Metadata of the table.
    compute : Compute

    Returns
    -------
    StarsFacts
    """
    solution, references = solved.mode, solved.references
    cov = None if correlated is None else correlated.covariance
    catalogue = star_catalogue(solution, cov, compute=compute)
    table = star_table(solution, catalogue, solved.matches.mag, references)
    table.meta |= notes
    if solved.contact is not None:
        table.meta["contact"] = list(solved.contact)
    write_table(table, folder / "stars.ecsv")
    path = folder / "stars.parquet"
    path.unlink(missing_ok=True)
    if len(table) > PARQUET_FROM:
        columns = {name: np.asarray(table[name]) for name in table.colnames}
        units = {name: str(table[name].unit) for name in columns if table[name].unit is not None}
        write_columns(path, columns, units)
    flags = np.asarray(table["flags"])
    sigma = np.hypot(table["sigma_u"], table["sigma_v"])
    radius_detections = np.hypot(table["sigma_own_u"], table["sigma_own_v"])
    return {
        "n": len(table),
        "unit": catalogue.unit,
        "epoch": catalogue.epoch or None,
        "n_two_detections": int((flags & FEW > 0).sum()),
        "n_doubtful": int((flags & DOUBTFUL > 0).sum()),
        "n_reference": int((flags & REFERENCE > 0).sum()),
        "radius_median": float(np.median(sigma)),
        "radius_own_median": float(np.median(radius_detections)),
    }


def star_table(
    solution: SelfCalibrationMode,
    found: StarCatalogue,
    mag: Float | None = None,
    references: ReferenceCatalog | None = None,
) -> Table:
    """Table of stars with their covariance, one row per star.

    Columns are u, v (and pm_u, pm_v); sigma_u and so on, which include the errors of distortion and
    frames in the gauge of the run; cov_u_v and so on; sigma_own_u and sigma_own_v from the
    detections of the star alone; n, n_members, mag (the median) and flags.
    """
    names = NAMES[: found.values.shape[1]]
    units = [f"{found.unit} / yr" if name.startswith("pm") else found.unit for name in names]
    table = Table({"star": np.arange(len(found))})
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        table[name] = Column(found.values[:, k], unit=unit)
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        table[f"sigma_{name}"] = Column(np.sqrt(found.cov[:, k, k]), unit=unit)
    for a, b in combinations(range(len(names)), 2):
        unit = Unit(units[a]) * Unit(units[b])
        table[f"cov_{names[a]}_{names[b]}"] = Column(found.cov[:, a, b], unit=unit)
    for k, name in enumerate(names[:2]):
        table[f"sigma_own_{name}"] = Column(np.sqrt(found.own[:, k, k]), unit=found.unit)
    table["n"] = found.n
    table["n_members"] = found.n_members
    if mag is not None:
        table["mag"] = solution.problem.medians(mag)
    flags = np.where(found.n == 2, FEW, 0)
    flags |= np.where(found.n_members < MIN_MEMBERS * found.n, DOUBTFUL, 0)
    flags |= np.where(solution.problem.priors.informed, REFERENCE, 0)
    table["flags"] = flags
    table.meta = {"flags": {str(bit): text for bit, text in FLAGS.items()}}
    if found.epoch:
        table.meta["epoch"] = found.epoch
    if references is not None and references.tangent_point:
        table.meta["tangent_point"] = list(references.tangent_point)
    return table
