"""`bayesdist.Run`: everything known about one calibration, in memory or in a folder."""

from __future__ import annotations

import os
import tempfile
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np
from astropy.table import Table

from bayesdist.app.products.made_files import with_facts_of_run
from bayesdist.app.python_terms import in_python_terms, python_terms
from bayesdist.app.report import title_of, write_html_report
from bayesdist.app.results import Results, errors_of, margins_of, results_of
from bayesdist.app.run_folder import copy_run, save_run
from bayesdist.app.stages import evaluated
from bayesdist.app.stages import run as run_configuration
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import ErrorBudget, Margin, Requirement, UncertaintyMap
from bayesdist.assess.budget import budget_of, place_budget
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.evaluation import Evaluation, position_map
from bayesdist.assess.requirements.requirement import as_requirements
from bayesdist.assess.requirements.verdict import VERDICT_LEVELS
from bayesdist.calibration.calibration import Calibration, calibration_of_exposure
from bayesdist.calibration.chip_map import chosen_chip
from bayesdist.calibration.sky_positions import sky_distribution
from bayesdist.calibration.sky_table import pixel_columns, position_column
from bayesdist.data import Matches
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit, Posterior
from bayesdist.model import DistortionModel
from bayesdist.products.registry import format_of
from bayesdist.report.html import (
    RunSummary,
    budget_rows,
    margin_rows,
    summary_html,
    summary_text,
)
from bayesdist.utils.checks import warnings_of
from bayesdist.utils.numbers import number, with_mas
from bayesdist.utils.quantities import Number, Random, value_in, values_in, whole_number, year_of

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.modeling import Model
    from astropy.table import QTable
    from xarray import DataTree

    from bayesdist.app.config import Config
    from bayesdist.calibration.wcs import CalibrationWCS
    from bayesdist.report.run_plots import RunPlots

__all__ = ["Run", "open_run", "run"]

Positions: TypeAlias = tuple[float, float] | Sequence[tuple[float, float]]


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """Everything known about one calibration: stars, model, posterior, diagnostics, evaluation.

    A run is made by `bayesdist.calibrate` or `bayesdist.run`, or opened with `bayesdist.open_run`.
    It may be used as a context manager, which closes it.

    Parameters
    ----------
    results : Results
        Artefacts of the run.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model = bd.DistortionModel(1, (chip,), "pix")
    >>> truth, rng = [0, 1000, 0, 0, 0, 1000], np.random.default_rng(1)
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> run = bd.calibrate(stars, order=1, size=(2048, 2048))
    >>> run.map().unit
    'pix'
    >>> run.check(bd.Requirement("whole field", "p95", 0.1))[0].verdict
    'undecided'
    """

    results: Results

    # -- content ----------------------------------------------------------------------------------

    @property
    def config(self) -> Config:
        """Resolved configuration."""
        return self.results.config

    @property
    def folder(self) -> Path | None:
        """Folder of the run; None if it is in memory."""
        return None if self.results.run.in_memory else self.results.run.path

    @property
    def matches(self) -> Matches:
        """Stars of the fit, with the errors that it used."""
        return self.results.data.stars

    @property
    def held_out(self) -> Matches | None:
        """Stars that were set aside to test the result; None if there are none."""
        return self.results.data.held

    @property
    def model(self) -> DistortionModel:
        """Structure and parameter layout of the distortion."""
        return self.results.fit.model

    @property
    def fit(self) -> LinearFit:
        """Least-squares fit, with formal errors."""
        return self.results.fit

    @property
    def posterior(self) -> Posterior:
        """Posterior as it was sampled, under the assumptions of its likelihood."""
        return self.results.posterior

    @property
    def solution(self) -> Posterior:
        """Posterior with the errors that the diagnostics found added; it is written to files."""
        return self.results.solution

    @property
    def diagnostics(self) -> Diagnostics:
        """Results of the tests of the residuals."""
        return self.results.diagnostics

    @cached_property
    def evaluation(self) -> Evaluation:
        """Maps, budget, margins, validity periods and checks."""
        return self.results.stored_evaluation or evaluated(self.results)

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration of the detector as it is written to files, with all errors of positions."""
        results, correlated = self.results, self.diagnostics.correlated
        return with_facts_of_run(
            results.product.calibration,
            results.config,
            results.fitted.tables.tables,
            self.evaluation.budget.rows(),
            None if correlated is None else correlated.facts,
        )

    @property
    def converged(self) -> bool:
        """True if the sampler reached its targets."""
        return self.posterior.convergence.converged

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the fit and its errors, as sentences."""
        return warnings_of(self.evaluation.checks)

    @property
    def margins(self) -> tuple[Margin, ...]:
        """Margins of the requirements that the run was given."""
        return self.evaluation.margins

    # -- questions --------------------------------------------------------------------------------

    @python_terms
    def budget(
        self,
        *,
        at: Positions | None = None,
        to: Positions | None = None,
        chip: int | None = None,
        epoch: Any = None,
        magnitude: Number | None = None,
    ) -> ErrorBudget:
        """Error budget over the detector, of some positions, or of separations.

        Parameters
        ----------
        at : (x, y) or sequence of (x, y), optional
            FITS 1-based pixels of one chip; by default the grid of all chips.
        to : (x, y) or sequence of (x, y), optional
            Pixels of the same image: the budget is then that of their separations from the one
            position `at`.
        chip : int, optional
            Number of the chip, needed with `at` if there are several.
        epoch : float or Time, optional
            Decimal years; that of the evaluation by default.
        magnitude : float or Quantity, optional
            Magnitude of the star: the error of its centroid is then a term.

        Returns
        -------
        ErrorBudget

        Raises
        ------
        InputError
            If a position is off the chip, the chip is unknown or not given, or `to` is given
            without one position `at`.
        """
        if to is not None and (at is None or len(_pairs(at, "at")) != 1):
            raise InputError(
                "a separation is measured from one position", where="budget", do="give at=(x, y)"
            )
        if magnitude is not None:
            magnitude = value_in(magnitude, "mag", "magnitude", where="budget")
        date = None if epoch is None else year_of(epoch)
        if at is None:
            if date is None and magnitude is None:
                return self.evaluation.budget
            domain = self.results.settings.domain(self.results.errors)
            domain = replace(domain, magnitude=magnitude)
            return budget_of(self._drawn, domain if date is None else domain.at(date))
        points = [*_pairs(at, "at"), *([] if to is None else _pairs(to, "to"))]
        x, y = zip(*points, strict=True)
        return place_budget(
            self._drawn,
            x,
            y,
            chip=self._chip(chip),
            epoch=self.results.epoch if date is None else date,
            magnitude=magnitude,
            relative=to is not None,
        )

    @cached_property
    def _drawn(self) -> DrawnErrors:
        """Draws of all errors of a position."""
        return errors_of(self.results)

    @python_terms
    def check(
        self, requirements: Requirement | Sequence[Requirement] | None = None
    ) -> tuple[Margin, ...]:
        """Margins of requirements, judged with everything that the diagnostics found.

        Parameters
        ----------
        requirements : Requirement or sequence of Requirement, optional
            Those that the run was given by default.

        Returns
        -------
        tuple of Margin

        Raises
        ------
        InputError
            If a requirement cannot be judged.
        """
        if requirements is None:
            return self.margins
        return margins_of(self.results, as_requirements(requirements))

    @python_terms
    def map(self, *, chip: int | None = None, epoch: Any = None) -> UncertaintyMap:
        """Map of the position uncertainty over a chip.

        Parameters
        ----------
        chip : int, optional
            Number of the chip, needed if there are several.
        epoch : float or Time, optional
            Decimal years; that of the evaluation by default.

        Returns
        -------
        UncertaintyMap

        Raises
        ------
        InputError
            If the chip is unknown or not given.
        """
        number = self._chip(chip)
        date = None if epoch is None else year_of(epoch)
        if date is None:
            return next(item for item in self.evaluation.maps if item.chip == number)
        results = self.results
        settings = replace(results.settings, epoch=date)
        chip_of_map = next(item for item in self.model.chips if item.number == number)
        return position_map(results.errors, results.solution, settings, chip_of_map)

    def _chip(self, number: int | None) -> int:
        """Number of a chip of the model; it has to be given if there are several."""
        numbers = [chip.number for chip in self.model.chips]
        return chosen_chip(numbers, number, where=str(self.folder or "the run"))

    # -- objects of other packages ----------------------------------------------------------------

    @property
    def plot(self) -> RunPlots:
        """Plots of the run: ``run.plot.map()``, ``run.plot.residuals()``, and others."""
        from bayesdist.report.run_plots import RunPlots  # matplotlib is only loaded for plots

        results = self.results
        return RunPlots(
            fit=self.fit,
            posterior=self.posterior,
            diagnostics=self.diagnostics,
            evaluation=self.evaluation,
            solution=self.solution,
            scale_mas=results.config.detector.scale_mas,
            magnitude_errors=results.fitted.errors.by_magnitude,
            rows=results.kind.rows,
        )

    @python_terms
    def wcs(
        self,
        chip: int | None = None,
        *,
        exposure: str | None = None,
        epoch: Any = None,
        **sky: Any,
    ) -> CalibrationWCS:
        """World coordinate system of a chip with its errors, as in APE 14.

        Parameters
        ----------
        chip : int, optional
            Number of the chip, needed if there are several.
        exposure : str, optional
            Name of an exposure whose own shift, rotation and scale are part of the result; by
            default those of the reference frame.
        epoch : float or Time, optional
            Decimal years.  If the model depends on time, the default is the date of the exposure,
            or of the evaluation without an exposure.
        **sky
            Position of the plane of u and v on the sky, if the matches do not have it: `point`,
            `position_angle`, `mirrored` and `pixel_scale`, as for `Calibration.wcs`.

        Returns
        -------
        CalibrationWCS
            Its pixels count from 0, unlike those of all other functions of this package.

        Raises
        ------
        InputError
            If there is no such chip or exposure, or a position on the sky is needed and not given.
        """
        date = self._date(exposure, epoch)
        if exposure is None:
            return self.calibration.wcs(chip, epoch=date, **sky)
        plain = self.calibration
        of_exposure = calibration_of_exposure(
            self.solution,
            exposure,
            epoch=date,
            plane=replace(plain.plane, note=""),
            detector=plain.detector,
            filter=plain.filter,
            scale=None if plain.scale is None else (plain.scale, plain.scale_from),
        )
        of_exposure = replace(
            of_exposure,
            further=plain.further,
            before=plain.before,
            after=plain.after,
            pixel_mas=plain.pixel_mas,
        )
        return of_exposure.wcs(chip, **sky)

    def _date(self, exposure: str | None, epoch: Any) -> float | None:
        """Decimal year of a calibration; None if the model does not depend on time."""
        date = None if epoch is None else year_of(epoch)
        if self.model.time is None:
            return None
        if date is not None:
            return date
        stars = self.results.data.sample
        if exposure in stars.exposure_names and stars.epoch is not None:
            rows = stars.exposure == stars.exposure_names.index(exposure)
            if rows.any():
                return float(stars.epoch[rows].mean())
        return self.results.epoch

    @python_terms
    def to_model(self, chip: int | None = None, *, epoch: Any = None, **sky: Any) -> Model:
        """Compound model of astropy.modeling from 0-based pixels to the sky, or to u and v.

        Parameters
        ----------
        chip, epoch, **sky
            As for `wcs`.

        Returns
        -------
        astropy.modeling.Model
            Two inputs and two outputs; it has an inverse.

        Raises
        ------
        InputError
            As for `wcs`.
        """
        return self.wcs(chip, epoch=epoch, **sky).to_model()

    def to_datatree(self) -> DataTree:
        """Posterior as an xarray DataTree, which ArviZ reads.

        Returns
        -------
        xarray.DataTree
        """
        return self.posterior.to_datatree()

    # -- representations --------------------------------------------------------------------------

    def __repr__(self) -> str:
        return summary_text(self._summary)

    def _repr_html_(self) -> str:
        return summary_html(self._summary)

    @property
    def _summary(self) -> RunSummary:
        """Content of the representations of a run: verdicts, warnings, a few facts."""
        evaluation, fit, config = self.evaluation, self.fit, self.results.config
        convergence = self.posterior.convergence
        scale_mas = config.detector.scale_mas
        largest = max(float(np.nanmax(chip_map.per_axis)) for chip_map in evaluation.maps)
        exposures = len(self.results.data.placed.exposures)
        state = f"yes, R-hat {convergence.rhat_max:.3f}, ESS {convergence.ess_bulk_min:.0f}"
        facts = [
            (self.results.kind.rows.capitalize(), f"{fit.n_rows}, {fit.n_used} used in the fit"),
            ("Exposures", str(exposures)),
            ("Model", f"order {fit.model.order}, {fit.model.n_params} parameters"),
            ("Converged", state if self.converged else f"NO: {'; '.join(convergence.reasons)}"),
            ("Largest uncertainty per axis", with_mas(largest, fit.unit, scale_mas)),
        ]
        if self.results.fitted.errors.by_magnitude is not None:
            facts.insert(1, ("Errors", "estimated from the residuals by magnitude"))
        if self.folder is not None:
            facts.append(("Folder", str(self.folder)))
        not_shown = [
            f"{m.requirement.name}: not shown: {m.reason}"
            for m in self.margins
            if m.verdict == "not shown"
        ]
        return RunSummary(
            title=title_of(config) or "calibration",
            verdict_level=self._level,
            headline=self._headline,
            warnings=(*self.warnings, *not_shown),
            facts=facts,
            margins_rows=margin_rows(self.margins),
            budget_rows=budget_rows(evaluation.budget, scale_mas=scale_mas),
        )

    @property
    def _level(self) -> str:
        """Level of the worst margin or check; 'note' if all is well and nothing was required."""
        level = self.evaluation.verdict[0] if self.converged else "fail"
        return "note" if level == "pass" and not self.margins else level

    @property
    def _headline(self) -> str:
        """Verdict in words, with the number of requirements that each verdict is given to."""
        if not self.converged:
            return "Not converged: no number of this run can be relied on"
        if not self.margins:
            return "No requirement was given"
        verdicts = [margin.verdict for margin in self.margins]
        if len(verdicts) == 1:
            return self._verdict_words(self.margins[0])
        counts = [(verdicts.count(name), name) for name in reversed(VERDICT_LEVELS)]
        return f"{len(verdicts)} requirements: " + ", ".join(
            f"{count} {name}" for count, name in counts if count
        )

    def _verdict_words(self, margin: Margin) -> str:
        """Verdict on a requirement with value, limit and probability."""
        asked, row = margin.requirement, margin_rows([margin])[0]
        statistic = f"{asked.statistic} {asked.scope}".strip()
        scale_mas = self.results.config.detector.scale_mas
        value = f"{row['Value']} {margin.unit}"
        if margin.unit == "pix" and scale_mas is not None:
            value += f" ({number(margin.value * scale_mas, 3)} mas)"
        qualifier = " by the known errors alone" if margin.verdict == "undecided" else ""
        return (
            f"{margin.verdict.upper()}: {asked.name}: {statistic} {value}, "
            f"limit {asked.limit:g} {asked.unit}, {margin.probability_words}{qualifier}"
        )

    @python_terms
    def to_sky(
        self, table: Any, *, draws: int | None = None, rng: Random = 1, **options: Any
    ) -> QTable | SkyCoord:
        """Positions on the sky of a table of pixels, with all errors that the run knows.

        Parameters
        ----------
        table : table
            Pixels of stars, with a column chip if the detector has several chips.
        draws : int, optional
            Number of random draws, for a SkyCoord of distributions in place of a table.
        rng : int or numpy.random.Generator
            Random numbers of the draws.
        **options
            Names of columns, pixel origin, chip, epoch and others, as for `Calibration.to_sky`.

        Returns
        -------
        QTable or SkyCoord
            The table with sky positions, their standard deviations and correlation.  With `draws`
            the positions alone, as `astropy.uncertainty.Distribution`, correlated between stars.

        Raises
        ------
        InputError
            If u and v do not lie on the sky, or columns or chips are unknown.
        """
        if self.model.time is not None:
            options = {"epoch": self.results.epoch} | options
        if draws is not None:
            draws = whole_number(draws, "draws", least=2, where="to_sky")
        positions = self.calibration.to_sky(table, **options)
        if draws is None:
            return positions
        rows = Table(positions)
        origin = positions.meta["pixel_origin"]
        x, y, _, _ = pixel_columns(rows, options.get("columns"), origin, "table")
        centroids = options.get("centroids")
        if centroids is not None:
            centroids = tuple(position_column(rows, name, "table") for name in centroids)
        chip = options.get("chip")
        if chip is None and "chip" in positions.colnames:
            chip = np.asarray(positions["chip"])
        return sky_distribution(
            self.calibration,
            x,
            y,
            n_draws=draws,
            rng=rng,
            chip=chip,
            epoch=options.get("epoch"),
            point=options.get("point"),
            centroids=centroids,
        )

    # -- files ------------------------------------------------------------------------------------

    @python_terms
    def write(self, format: str, file: str | os.PathLike[str], **settings: Any) -> list[Path]:
        """Write the calibration in the format of a pipeline.

        Parameters
        ----------
        format : str
            Name of the format, such as 'sip' or 'tpv'; `bayesdist.formats.list_formats` lists them.
        file : path-like
            File to write, or a folder for a format with several files.
        **settings
            Settings of the format and options, as for `Calibration.write`.  The date is that of
            the evaluation by default, if the format holds one date and the model depends on time.

        Returns
        -------
        list of Path
            Files that were written.

        Raises
        ------
        InputError
            If the format or a setting is unknown, the file exists, or the format cannot hold the
            calibration.

        Warns
        -----
        bayesdist.errors.BayesdistWarning
            As for `Calibration.write`.
        """
        if self.model.time is not None and not format_of(format).holds_time:
            settings = {"epoch": self.results.epoch} | settings
        return self.calibration.write(format, file, **settings)

    @python_terms
    def report(self, path: str | os.PathLike[str]) -> Path:
        """Write the report of the run as one HTML file.

        Parameters
        ----------
        path : path-like
            Name of the file, which ends in ``.html``.

        Returns
        -------
        pathlib.Path

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        write_html_report(self.results, Path(path))
        return Path(path)

    def show(self) -> None:
        """Open the report in a web browser."""
        folder = Path(tempfile.mkdtemp(prefix="bayesdist-"))
        webbrowser.open(self.report(folder / "report.html").as_uri())

    @python_terms
    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write the run to a folder, which `open_run` and all commands read.

        Parameters
        ----------
        folder : path-like
            New or empty folder; it appears whole or not at all.

        Returns
        -------
        pathlib.Path
            The folder.

        Raises
        ------
        InputError
            If the folder is not empty, or files that the run was made from have changed.
        """
        folder = Path(folder)
        if self.results.run.in_memory:
            save_run(self.results, folder)
        else:
            copy_run(self.results.run, folder)
        return folder

    def close(self) -> None:
        """Release the stars, and the processes that hold them."""
        self.results.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@in_python_terms(keys=False)
def open_run(folder: str | os.PathLike[str]) -> Run:
    """Open a run that is in a folder.

    Parameters
    ----------
    folder : path-like

    Returns
    -------
    Run
        Its parts are read when they are first used.

    Raises
    ------
    InputError
        If the folder holds no run, the run has not been sampled, or its inputs have changed.

    Examples
    --------
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model = bd.DistortionModel(1, (chip,), "pix")
    >>> truth, rng = [0, 1000, 0, 0, 0, 1000], np.random.default_rng(1)
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> folder = bd.calibrate(stars, order=1, size=(2048, 2048)).save("camera-run")
    >>> bd.open_run("camera-run").model.order
    1
    """
    directory = RunDirectory(Path(folder))
    if not directory.is_initialized:
        raise InputError(
            "is no run: it has no run.json",
            where=str(folder),
            do="restore it, or make the run again with bayesdist.run",
        )
    directory = RunDirectory.open(Path(folder))
    directory.require("open_run", ("fit", "sample", "diagnose"))
    return Run(results_of(directory))


@in_python_terms(keys=False)
def run(
    config: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    resume: bool = False,
    overwrite: bool = False,
    seed: int | None = None,
    report: bool = True,
) -> Run:
    """Make the run of a configuration file, as ``bayesdist run`` does.

    Parameters
    ----------
    config : path-like
        TOML file; paths in it are relative to it.
    folder : path-like
        Folder of the run.
    resume : bool
        Resume the run that is in the folder.
    overwrite : bool
        Replace the run that is in the folder.
    seed : int, optional
        Seed in place of the configured one.
    report : bool
        False to leave out the report and its figures, which may take as long as everything else;
        `Run.report` writes it at any time.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        If the configuration or its inputs cannot be used, or the folder holds something else.

    Examples
    --------
    >>> from pathlib import Path
    >>> chip = bd.Chip(1, "camera", (2048, 2048), (1024.5, 1024.5))
    >>> model = bd.DistortionModel(1, (chip,), "pix")
    >>> truth, rng = [0, 1000, 0, 0, 0, 1000], np.random.default_rng(1)
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    >>> stars.to_table().write("stars.ecsv")
    >>> config = '''
    ... data = {matches = "stars.ecsv"}
    ... detector = {size = [2048, 2048]}
    ... model = {order = 1}
    ... '''
    >>> n = Path("camera.toml").write_text(config)
    >>> bd.run("camera.toml", "camera-run", report=False).model.order
    1
    """
    if (Path(folder) / "run.json").exists() and not (resume or overwrite):
        raise InputError(
            "the folder holds another run",
            where=str(folder),
            do="give resume=True or overwrite=True, or choose another folder",
        )
    return open_run(
        run_configuration(
            Path(config), Path(folder), resume=resume, force=overwrite, seed=seed, report=report
        )
    )


def _pairs(positions: Positions, name: str) -> list[tuple[float, float]]:
    """Positions (x, y) as a list of pairs; a single position becomes a list with one pair."""
    try:
        pairs = np.atleast_2d(np.asarray(_without_unit(positions, name), float))
    except (TypeError, ValueError):
        pairs = np.zeros((0, 0))
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise InputError(
            f"{name} is {positions!r}", where="budget", do="give (x, y), or a list of such pairs"
        )
    return [(float(x), float(y)) for x, y in pairs]


def _without_unit(positions: Any, name: str) -> Any:
    """Positions as plain numbers; those with a unit other than the pixel are refused."""
    several = isinstance(positions, list | tuple)
    if several and not any(hasattr(value, "to_value") for value in positions):
        return [_without_unit(value, name) for value in positions]
    if several or hasattr(positions, "to_value"):
        return values_in(positions, "pix", name, where="budget")
    return positions
