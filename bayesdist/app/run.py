"""`bayesdist.Run`: everything known about one calibration, in memory or in a folder."""

from __future__ import annotations

import os
import tempfile
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar

import numpy as np

from bayesdist.app import hooks
from bayesdist.app.parts import NO_TABLES, Part, StoredLookupTables
from bayesdist.app.python_terms import python_terms
from bayesdist.app.result_files import load_diagnostics, load_evaluation
from bayesdist.app.stars import QUOTED, ErrorLaw, RunInput, StarReader
from bayesdist.app.store import as_json
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess import ErrorBudget, Margin, Requirement, UncertaintyMap
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.evaluation import Evaluation, EvaluationSettings
from bayesdist.assess.model import ErrorModel, with_diagnosed_errors
from bayesdist.assess.requirements.requirement import as_requirements
from bayesdist.calibration.calibration import Calibration
from bayesdist.data import Matches, ReferenceCatalog
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.residuals.misfit import error_scale_sentence
from bayesdist.diagnose.residuals.stars import dates_of
from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors, LinearFit, Posterior, Shards, load_posterior
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.model import DistortionModel
from bayesdist.plugin import load_object
from bayesdist.products.registry import format_of
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import Check, warnings_of
from bayesdist.utils.quantities import Number, Random, whole_number

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.modeling import Model
    from astropy.table import QTable, Table
    from xarray import DataTree

    from bayesdist.app.config import Config
    from bayesdist.app.kind import RunKind
    from bayesdist.assess.comparison.compare import Comparison
    from bayesdist.calibration.wcs import CalibrationWCS
    from bayesdist.report.run_plots import RunPlots

__all__ = ["Run"]

Positions: TypeAlias = tuple[float, float] | Sequence[tuple[float, float]]
P = TypeVar("P", bound=Part)
T = TypeVar("T")

# artefacts by the stage that makes them, in order, with what follows from them and is kept with
# them; artefacts of later stages depend on those of earlier ones
STAGES: Mapping[str, tuple[str, ...]] = {
    "read": ("config", "kind", "inputs"),
    "match": (
        *("stars", "held_stars", "held_exposures"),
        *("match_facts", "match_table", "match_parts", "_matched"),
    ),
    "fit": (
        *("fit", "errors", "priors", "added_errors", "parts", "fit_facts", "_fitted"),
        *("placed", "matches", "held_out", "dates", "last_epoch"),
    ),
    "sample": ("posterior",),
    "diagnose": ("diagnostics", "stored_diagnostics", "solution", "error_model"),
    "evaluate": ("evaluation",),
    "export": ("products",),
    "report": ("figures",),
}
PROVENANCE = ("command", "created", "seed", "inputs", "versions")  # facts of run.json
# artefacts, and what was derived from them, that pickled runs keep if they have been used
RESULTS = ("posterior", "diagnostics", "evaluation")
DERIVED = ("config", "solution", "previous", "report_data")
ORDER = {name: place for place, names in enumerate(STAGES.values()) for name in names}


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """Everything known about one calibration: stars, model, posterior, diagnostics, evaluation.

    A run is made by `bayesdist.calibrate` or `bayesdist.run`, or opened with `bayesdist.open_run`.
    It may be used as a context manager, which closes it.  Artefacts are made by the stages of a
    run, or loaded from its folder when they are first used.

    Parameters
    ----------
    directory : RunDirectory
        Folder of the run with its configuration and record; it may be one in memory.
    reader : StarReader
        Cache of the stars, which all stages share.
    made : mapping of str to object
        Artefacts made by this process, which replace those in the folder.
    source : RunInput, optional
        Matches in the format of a mission, which may have to be selected before they are read.

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

    directory: RunDirectory
    reader: StarReader
    made: Mapping[str, Any] = field(default_factory=dict)
    source: RunInput | None = None

    # -- content ----------------------------------------------------------------------------------

    @cached_property
    def config(self) -> Config:
        """Resolved configuration."""
        return self.directory.config

    @property
    def folder(self) -> Path | None:
        """Folder of the run; None if it is in memory."""
        return None if self.directory.in_memory else self.directory.path

    @cached_property
    def matches(self) -> Matches:
        """Stars of the fit at the pixels that it used, with the errors that it assumed."""
        return self.reader.matches(self.placed, self._remaining_errors)

    @cached_property
    def held_out(self) -> Matches | None:
        """Held-out stars, in the form of `matches`; None if there are none."""
        held = self.held_stars
        return None if held is None else self.errors.applied(self.as_placed(held))

    @property
    def model(self) -> DistortionModel:
        """Structure and parameter layout of the distortion."""
        return self.fit.model

    @property
    def fit(self) -> LinearFit:
        """Least-squares fit, with formal errors."""
        fit: LinearFit = self._fitted["fit"]
        return fit

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior as it was sampled, under the assumptions of its likelihood."""
        return self._artefact(
            "posterior", "sample", lambda: load_posterior(self.directory / "posterior.nc")
        )

    @cached_property
    def solution(self) -> Posterior:
        """Posterior with the errors that the diagnostics found added; it is written to files."""
        return with_diagnosed_errors(self.posterior, self.stored_diagnostics, self.hierarchy)

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """Results of the tests of the residuals; of the fit alone if nothing was sampled."""
        stored = self.stored_diagnostics if self.is_sampled else None
        if stored is not None:
            return stored
        diagnostics: Diagnostics = load_object(hooks.DIAGNOSE)(self)
        return diagnostics

    @cached_property
    def evaluation(self) -> Evaluation:
        """Maps, budget, margins, validity periods and checks."""
        evaluation: Evaluation = self.stored_evaluation or load_object(hooks.EVALUATE)(self)
        return evaluation

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration of the detector as it is written to files, with all errors of positions."""
        calibration: Calibration = load_object(hooks.CALIBRATION)(self)
        return calibration

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
        budget: ErrorBudget = load_object(hooks.BUDGET)(
            self, at=at, to=to, chip=chip, epoch=epoch, magnitude=magnitude
        )
        return budget

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
        margins: tuple[Margin, ...] = load_object(hooks.MARGINS)(
            self, as_requirements(requirements)
        )
        return margins

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
        chip_map: UncertaintyMap = load_object(hooks.MAP)(self, chip, epoch)
        return chip_map

    # -- objects of other packages ----------------------------------------------------------------

    @property
    def plot(self) -> RunPlots:
        """Plots of the run: ``run.plot.map()``, ``run.plot.residuals()``, and others."""
        plots: RunPlots = load_object(hooks.PLOT)(self)
        return plots

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
        wcs: CalibrationWCS = load_object(hooks.WCS)(self, chip, exposure, epoch, **sky)
        return wcs

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
        text: str = load_object(hooks.TEXT)(self)
        return text

    def _repr_html_(self) -> str:
        text: str = load_object(hooks.HTML)(self)
        return text

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
        if draws is not None:
            draws = whole_number(draws, "draws", least=2, where="to_sky")
        positions: QTable | SkyCoord = load_object(hooks.TO_SKY)(self, table, draws, rng, **options)
        return positions

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
            settings = {"epoch": self.epoch} | settings
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
        load_object(hooks.REPORT)(self, Path(path))
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
        load_object(hooks.SAVE)(self, Path(folder))
        return Path(folder)

    def close(self) -> None:
        """Release the stars, and the processes that hold them; remove temporary files."""
        self.reader.close()
        if self.source is not None:
            self.source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- stages -----------------------------------------------------------------------------------

    @classmethod
    def of(cls, directory: RunDirectory) -> Run:
        """Run of a directory; the caller must close it."""
        config = directory.config
        source: RunInput | None = load_object(config.kind).source(directory)
        return cls(directory, StarReader(config.resources()), source=source)

    def having(self, **artefacts: Any) -> Run:
        """Run with the artefacts of a stage replaced, by name.

        Other artefacts of this stage and those of later stages are dropped.
        """
        unknown = artefacts.keys() - ORDER
        if unknown:
            raise LookupError(f"no artefact of a run: {', '.join(sorted(unknown))}")
        first = min(ORDER[name] for name in artefacts)
        made = {name: value for name, value in self.made.items() if ORDER[name] < first}
        run = replace(self, made={**made, **artefacts})
        # what was loaded or derived before
        vars(run).update((n, v) for n, v in vars(self).items() if ORDER.get(n, first) < first)
        return run

    def adopting_inputs(self) -> Run:
        """Run with inputs moved into its folder, if they were prepared elsewhere."""
        if self.source is None or not self.source.move_into_run():
            return self
        fitted = {name: self.made[name] for name in STAGES["fit"] if name in self.made}
        moved = self.having(inputs=self.source.load())
        self.reader.moved(moved.stars)
        return moved.having(**fitted)

    def with_config(self, config: Config) -> Run:
        """Run of another configuration; artefacts that depend on the change must be made again."""
        run = replace(
            self, made={**self.made, "inputs": self.kind.with_config(self.inputs, config)}
        )
        kept = ORDER.keys() - {"inputs", "error_model"}
        vars(run).update((name, value) for name, value in vars(self).items() if name in kept)
        vars(run)["config"] = config
        return run

    def __reduce__(self) -> tuple[Callable[..., Run], tuple[object, ...]]:
        """Pickle the results of a run; its stars and inputs are read again from its folder.

        A run in memory is pickled with its stars.
        """
        if self.directory.in_memory:
            return _unpickled, (self.directory, self.source, dict(self.made), {})
        loaded = {name: vars(self)[name] for name in RESULTS if name in vars(self)}
        made = {**self.made, **vars(self).get("_fitted", {}), **loaded}
        read_again = {*STAGES["read"], *STAGES["match"]}
        made = {name: value for name, value in made.items() if name not in read_again}
        derived = {name: vars(self)[name] for name in DERIVED if name in vars(self)}
        return _unpickled, (self.directory, None, made, derived)

    def _artefact(self, name: str, stage: str, load: Callable[[], T]) -> T:
        """Artefact made by this process, otherwise loaded from the folder if undamaged."""
        if self.made.get(name) is not None:
            artefact: T = self.made[name]
            return artefact
        self.directory.refuse_damaged(stage)
        return load()

    # -- inputs -----------------------------------------------------------------------------------

    @cached_property
    def base(self) -> Path:
        """Folder that file names in the configuration are relative to."""
        return self.directory.base

    @cached_property
    def kind(self) -> RunKind[Any, Any]:
        """Kind of the run, which answers what differs between matches, campaigns and others."""
        kind: RunKind[Any, Any] = load_object(self.config.kind)
        return kind

    @cached_property
    def inputs(self) -> Any:
        """Inputs of the run: matched stars, or star lists with their catalogue and exposure log."""
        if "inputs" in self.made:
            return self.made["inputs"]
        if self.source is not None:
            return self.source.load()
        return self.kind.read(self.config, self.base)

    # -- matches ----------------------------------------------------------------------------------

    @cached_property
    def _matched(self) -> Mapping[str, Any]:
        """Artefacts of the stage 'match', made by this process or loaded."""
        if "stars" in self.made:
            return self.made
        self.directory.refuse_damaged("match")
        return self.kind.load_matched(self).made

    @property
    def stars(self) -> Matches:
        """Stars to fit as matched, with quoted errors; `matches` has them as the fit used them."""
        stars: Matches = self._matched["stars"]
        return stars

    @property
    def held_stars(self) -> Matches | None:
        """Held-out stars as they were matched; None if there are none."""
        return self._matched.get("held_stars")

    @property
    def held_exposures(self) -> tuple[str, ...]:
        """Names of exposures that are held out entirely."""
        return self._matched.get("held_exposures", ())

    @property
    def match_facts(self) -> Mapping[str, Any]:
        """Section of summary.json on the matching, which the kind names."""
        return self._matched.get("match_facts", {})

    @property
    def match_table(self) -> Table | None:
        """Matching of star lists, one row per exposure; None unless this process matched them."""
        return self._matched.get("match_table")

    @property
    def match_parts(self) -> Mapping[str, Part]:
        """Results of the matching that only some kinds of runs have, by name."""
        return self._matched.get("match_parts", {})

    @property
    def tangent_point(self) -> tuple[float, float] | None:
        """RA and Dec of (u, v) = (0, 0) in degrees; None if u, v are not along the sky."""
        return None if self.kind.along_detector else self.stars.tangent_point

    @property
    def catalogue(self) -> ReferenceCatalog | None:
        """Reference catalogue; None if only the matches are known."""
        return self.kind.catalogue(self)

    @property
    def catalogue_name(self) -> str:
        """File name of the reference catalogue, or 'catalogue' if it is unknown."""
        catalogue = self.catalogue
        return "catalogue" if catalogue is None else Path(catalogue.source).name

    @property
    def filter(self) -> str:
        """Filter of the exposures; empty if it has no name."""
        return self.kind.filter(self)

    # -- fit --------------------------------------------------------------------------------------

    @cached_property
    def _fitted(self) -> Mapping[str, Any]:
        """Artefacts of the stage 'fit', made by this process or loaded."""
        if "fit" in self.made:
            return self.made
        self.directory.refuse_damaged("fit")
        return self.kind.load_fit(self).made

    @property
    def errors(self) -> ErrorLaw:
        """Measurement errors of fitted and held-out stars that the fit assumed."""
        return self._fitted.get("errors", QUOTED)

    @property
    def priors(self) -> GaussianPriors:
        """Priors on the parameters."""
        priors: GaussianPriors = self._fitted["priors"]
        return priors

    @property
    def added_errors(self) -> GroupedErrors | None:
        """Errors in addition to the quoted ones; None if no groups of stars were compared."""
        return self._fitted.get("added_errors")

    @property
    def parts(self) -> Mapping[str, Part]:
        """Results of the fit that only some kinds of runs have, by name."""
        return self._fitted.get("parts", {})

    @property
    def fit_facts(self) -> Mapping[str, Any]:
        """Sections of summary.json that are known only while the fit is made."""
        return self._fitted.get("fit_facts", {})

    def part(self, kind: type[P]) -> P:
        """Part of the given class, which the kind of run has; raises InputError if it is absent."""
        parts = self.match_parts if kind.stage == "match" else self.parts
        for part in parts.values():
            if isinstance(part, kind):
                return part
        raise InputError(
            f"has no {kind.title}",
            where=str(self.directory.path),
            do=f"run the stage '{kind.stage}' again",
        )

    @property
    def tables(self) -> StoredLookupTables:
        """Look-up tables with their errors; empty if the fit has none."""
        tables = (part for part in self.parts.values() if isinstance(part, StoredLookupTables))
        return next(tables, NO_TABLES)

    @property
    def hierarchy(self) -> LinearFit | None:
        """The fit, if its exposures scatter about its solution; else None."""
        return self.fit if any(part.is_hierarchy for part in self.parts.values()) else None

    @property
    def gauge_words(self) -> str:
        """Sentence that states the gauge of the products; may be empty."""
        return " ".join(filter(None, (part.gauge_sentence() for part in self.parts.values())))

    @property
    def _remaining_errors(self) -> ErrorLaw:
        """Errors to apply to the stars that `as_placed` returns."""
        return QUOTED if any(part.applies_errors for part in self.parts.values()) else self.errors

    def as_placed(self, stars: Matches) -> Matches:
        """Stars at the positions that the fit has used, for example corrected by tables."""
        for part in self.parts.values():
            stars = part.placed(stars, self.model)
        return stars

    @cached_property
    def placed(self) -> Matches:
        """Fitted stars at the positions that the fit has used, with their quoted errors."""
        return self.as_placed(self.stars)

    @property
    def shards(self) -> Shards:
        """All fitted stars, split into shards for passes over the data."""
        return self.reader.shards(self.model, self.placed, self._remaining_errors)

    @property
    def sample(self) -> Matches:
        """Evenly spread subset of the fitted stars, or all of them if they are few."""
        return self.reader.sample(self.placed, self._remaining_errors)

    @cached_property
    def dates(self) -> Float:
        """Distinct dates of the stars in decimal years; empty if they have no dates."""
        return dates_of(self.placed if self.placed.in_memory else self.sample)

    @cached_property
    def last_epoch(self) -> float:
        """Latest date of the stars in decimal years; they must have dates if the model drifts."""
        if self.placed.in_memory:
            return float(np.max(self.placed.column("epoch")))
        return float(np.max(self.shards.groups.epoch))

    @property
    def error_scale_sentence(self) -> str:
        """Sentence about quoted errors that are far too small; empty if they are adequate."""
        if self.errors.factor == 1.0:
            return ""
        return error_scale_sentence(
            self.errors.factor,
            self.shards.survey.reference_sigma,
            self.model.unit,
            by_magnitude=self.placed.has_mag,
        )

    # -- posterior and assessment -----------------------------------------------------------------

    @property
    def is_sampled(self) -> bool:
        """True if there is a posterior."""
        return "posterior" in self.made or (self.directory / "posterior.nc").exists()

    @cached_property
    def stored_diagnostics(self) -> Diagnostics | None:
        """Diagnostics that were made or stored; None if there are none."""
        return self._artefact(
            "diagnostics",
            "diagnose",
            lambda: load_diagnostics(self.directory, self.fit, self.posterior),
        )

    @property
    def stored_evaluation(self) -> Evaluation | None:
        """Evaluation that was made or stored; None if there is none of this posterior."""
        if "evaluation" not in self.made and not self.directory.done("evaluate"):
            return None
        return self._artefact(
            "evaluation",
            "evaluate",
            lambda: load_evaluation(self.directory, self.fit, self.posterior),
        )

    @cached_property
    def error_model(self) -> ErrorModel:
        """Error model of positions, with all errors."""
        model: ErrorModel = load_object(hooks.ERROR_MODEL)(self)
        return model

    @cached_property
    def drawn_errors(self) -> DrawnErrors:
        """Draws of all position errors, including those of products."""
        drawn: DrawnErrors = load_object(hooks.DRAWN_ERRORS)(self)
        return drawn

    @cached_property
    def evaluation_settings(self) -> EvaluationSettings:
        """Settings of the evaluation."""
        settings: EvaluationSettings = load_object(hooks.SETTINGS)(self)
        return settings

    @property
    def epoch(self) -> float | None:
        """Epoch of the assessment in decimal years; None if the model does not depend on time.

        By default it is the date from which a product is to be used, or the latest date of the
        stars if that is later, because errors of a drift grow with time.
        """
        if self.config.assess.epoch is not None or self.model.time is None:
            return self.config.assess.epoch  # without reading the stars
        return max((self.last_epoch, *self.config.products.useafter_years()))

    # -- report -----------------------------------------------------------------------------------

    @property
    def title(self) -> str:
        """Name of the calibration: its detector, or else its folder."""
        return self.config.detector_title or self.directory.path.resolve().name

    @cached_property
    def configuration(self) -> Mapping[str, Any]:
        """Resolved configuration as in JSON, by section."""
        configuration: Mapping[str, Any] = as_json(self.config.model_dump(exclude_none=True))
        return configuration

    @property
    def held_parameters(self) -> frozenset[str]:
        """Names of the parameters that a prior or the gauge alone constrains."""
        return self.kind.held_parameters(self)

    @cached_property
    def previous(self) -> tuple[Comparison, ...]:
        """Difference from the release that the run replaces, by chip; empty if none is named."""
        previous: tuple[Comparison, ...] = load_object(hooks.PREVIOUS)(self)
        return previous

    @cached_property
    def report_data(self) -> Any:
        """Additional data that the figures of this kind of run draw; None if there are none."""
        return self.kind.report_data(self)

    @property
    def summary(self) -> Mapping[str, Any]:
        """Sections of summary.json."""
        return self.directory.summary

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Folder, command, start, seed, inputs, versions and stages of the run."""
        facts = self.directory.facts
        return {
            "folder": self.directory.path.resolve().name,
            **{name: facts[name] for name in PROVENANCE},
            "stages": self.directory.record.stages,
        }

    @property
    def source_name(self) -> str:
        """Name of the run in its products; empty if it has no folder."""
        return "" if self.directory.in_memory else str(self.directory.path)

    @property
    def time_dependence(self) -> Mapping[str, Any]:
        """Section 'time_dependence' of summary.json; empty if there is none."""
        section: Mapping[str, Any] = self.directory.summary.get("time_dependence", {})
        return section

    @property
    def checks(self) -> tuple[Check, ...]:
        """All checks except those of an evaluation."""
        checks: tuple[Check, ...] = load_object(hooks.CHECKS)(self)
        return checks


def _unpickled(
    directory: RunDirectory,
    source: RunInput | None,
    made: Mapping[str, Any],
    derived: Mapping[str, Any],
) -> Run:
    """Run that was pickled; without a source it is the run of its folder."""
    run = replace(Run.of(directory), made=made)
    if source is not None:
        run = replace(run, source=source)
    vars(run).update(derived)
    return run
