"""Sections that the configurations of all kinds of runs have in common."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

from pydantic import Field

from bayesdist.app.config.fit import (
    BaseFit,
    BaseOutliers,
    BaseSampler,
    ComputeBlock,
    DiscrepancyBlock,
    Fit,
    HoldoutBlock,
    MatchedModel,
    Outliers,
    Periods,
    PriorBlock,
    PriorCalibrationBlock,
    Sampler,
    StructureBlock,
    TablesBlock,
)
from bayesdist.app.config.results import (
    MEASURED_TERMS,
    Assess,
    BudgetBlock,
    CatalogueBlock,
    MatchedProducts,
    ProductsBlock,
    RequirementBlock,
)
from bayesdist.app.config.section import (
    ChipBlock,
    Circle,
    RunDetector,
    Section,
    chips_of,
    detector_faults,
    same_names,
)
from bayesdist.assess import Requirement, UserTerm
from bayesdist.assess.domain import MIN_POSITIONS, WHOLE, Region, check_region, in_region
from bayesdist.assess.terms.forms import ErrorTerm
from bayesdist.assess.terms.given import names_motions, said_by_user, stated_names
from bayesdist.assess.terms.parameters import one_size_term
from bayesdist.assess.units import stated_unit
from bayesdist.errors import InputError
from bayesdist.infer import Compute, OutlierMixture
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import Chip, TimeDependence
from bayesdist.model.grid import grid_pixels, mesh

FREE = "free"  # rates that are not taken from another run
TABLES, POSTERIOR = "tables.h5", "posterior.nc"


MOST_NAMED = 3  # largest number of chips named in a title


class RunConfig(Section):
    """Sections of every configuration of a run; each kind adds further sections."""

    if TYPE_CHECKING:
        model: StructureBlock
        outliers: BaseOutliers
        sampler: BaseSampler
        products: ProductsBlock

        @property
        def tables(self) -> TablesBlock: ...

        @property
        def fit(self) -> BaseFit: ...

        @property
        def periods(self) -> Periods | None: ...

        @property
        def holdout(self) -> HoldoutBlock | None: ...

        @property
        def prior(self) -> Sequence[PriorBlock]: ...

        @property
        def prior_calibration(self) -> PriorCalibrationBlock | None: ...

        @property
        def compute(self) -> ComputeBlock: ...

    kind: ClassVar[str]  # the kind of run as "module:object"
    title: ClassVar[str]  # what the run begins with
    begins_with: ClassVar[str] = "match"  # first stage; 'fit' if stars are matched before the run
    is_dated: ClassVar[bool] = False  # True if all exposures have dates
    renamed: ClassVar[Mapping[str, str]] = {
        "assess.horizon": "years_ahead",
        "budget.in_residuals": "included_in_scatter",
    }

    detector: RunDetector = RunDetector()
    chip: list[ChipBlock] = Field(default_factory=list)
    assess: Assess = Assess()
    catalogue: CatalogueBlock | None = None
    budget: list[BudgetBlock] = Field(default_factory=list)
    requirement: list[RequirementBlock] = Field(default_factory=list)
    discrepancy: DiscrepancyBlock = DiscrepancyBlock()

    def faults(self) -> Iterator[str]:
        """Faults of names, chips and detector, and of products that do not suit the detector."""
        yield from same_names("budget", [b.name for b in self.budget])
        yield from same_names("requirement", [r.name for r in self.requirement])
        reserved = next((b.name for b in self.budget if b.name in MEASURED_TERMS), None)
        if reserved is not None:
            yield (
                f"a [[budget]] block has the name {reserved!r}, which is reserved for a measured "
                "row; give it another name"
            )
        twice = next((b.name for b in self.budget if b.of_catalogue and b.stated), None)
        if self.catalogue is not None and twice is not None:
            yield (
                f"[catalogue] states the errors of the catalogue, and so does the [[budget]] block "
                f"{twice!r}; leave one of the two out"
            )
        yield from detector_faults(self.chip, self.detector, self.model.reference_pixel)
        if self.chip and self.detector.field is not None:
            yield (
                "detector.field applies to a detector with a single chip, but there are [[chip]] "
                "blocks; leave it out, and give each requirement the region of its chip"
            )
        yield from self._field_faults()
        for settings in self.products.asked().values():
            settings.check(self.named_detector, self.detector.size, self.model.reference_pixel)

    def _field_faults(self) -> Iterator[str]:
        """Fault of a field of the detector that holds too few points of the grid."""
        size, grid = self.detector.size, self.assess.grid
        if size is None or self.field == WHOLE:
            return
        n_points = int(in_region(self.field, size, *mesh(*grid_pixels(size, grid))).sum())
        if n_points < MIN_POSITIONS:
            yield (
                f"detector.field holds {n_points} points of the grid of {grid[0]} x {grid[1]} on "
                f"the detector of {size[0]:g} x {size[1]:g} pixels; correct its pixels, enlarge "
                "it, or refine assess.grid"
            )

    @property
    def named_detector(self) -> str:
        """Name of the detector, for formats that are specific to one detector."""
        return self.detector.name

    @property
    def detector_title(self) -> str:
        """Mission, instrument, detector or chips, and filter, as far as they are given."""
        block, names = self.detector, [chip.name for chip in self.chip if chip.name]
        is_short = len(names) <= MOST_NAMED
        detector = block.name or (" and ".join(names) if is_short else f"{names[0]} to {names[-1]}")
        named = " ".join(part for part in (block.mission, block.instrument, detector) if part)
        return ", ".join(part for part in (named, self.filter_name) if part)

    @property
    def filter_name(self) -> str:
        """Filter of the exposures, if the settings name it; may be empty."""
        return self.detector.filter or ""

    @property
    def fits_on_grid(self) -> bool:
        """True if the fit writes errors of tables on the grid of the assessment."""
        return False

    @property
    def compares_jitters(self) -> bool:
        """True if groups of stars may have separate jitters, if the data support it."""
        return False

    def named_files(self, base: Path) -> Path | list[Path]:
        """Files, patterns and folders that the solution is made from, without duplicates.

        Relative names are relative to `base`.  The result is a single path for matches with one
        name.
        """
        raise NotImplementedError

    def files_of_products(self, base: Path) -> list[Path]:
        """Files that are used only by the products and the report of a run."""
        release, named = self.products.release, self.named_files(base)
        files = [] if release is None else [base / release.reference]
        if self.products.previous is not None:
            files.append(previous_file(base / self.products.previous))
        solution_files = named if isinstance(named, list) else [named]
        return [path for path in files if path not in solution_files]

    def files_of_priors(self, base: Path) -> list[Path]:  # noqa: ARG002 - used by one kind of run
        """Files of earlier calibrations that are used as priors."""
        return []

    def of_order(self, order: int) -> Self:
        """Configuration with polynomials of another order."""
        return self.model_copy(update={"model": self.model.model_copy(update={"order": order})})

    def holding_at_most(self, memory_mb: float) -> Self:
        """Configuration with at most `memory_mb` megabytes of stars in memory."""
        limit = min(memory_mb, self.compute.memory_mb)
        compute = self.compute.model_copy(update={"memory_mb": limit})
        return self.model_copy(update={"compute": compute})

    def chips(self) -> tuple[Chip, ...]:
        """Chips of the model; empty for a detector with one chip."""
        return chips_of(self.chip)

    def time(self) -> TimeDependence | None:
        """Time dependence of the model."""
        return None if self.model.tdd is None else self.model.tdd.time()

    @property
    def has_free_rates(self) -> bool:
        """True if the drift is determined by the exposures of this run."""
        return self.model.tdd is None or self.model.tdd.rates == FREE

    def match_radius(self, stated: float | None) -> float | None:
        """Match radius: the configured one, or else that which the matches state."""
        configured = self.outliers.match_radius
        return stated if configured is None else configured

    def mixture(self, stated: float | None = None) -> OutlierMixture:
        """Outlier mixture; `stated` is the match radius that the matches state."""
        return self.outliers.mixture(self.match_radius(stated))

    def resources(self) -> Compute:
        """Resources for the computation."""
        return self.compute.resources()

    def spans(self) -> dict[str, tuple[float, float]]:
        """Start and end of each period in decimal years; empty if there are none."""
        return {}

    @property
    def states_catalogue(self) -> bool:
        """True if [catalogue] or a [[budget]] row states the error of the catalogue positions."""
        stated = any(row.stated and row.of_catalogue for row in self.budget)
        return stated or self.catalogue is not None

    @property
    def states_motions(self) -> bool:
        """True if [catalogue] or a [[budget]] row states the error of proper motions."""
        stated = any(row.stated and row.of_motions for row in self.budget)
        return stated or any(map(names_motions, self.stated_errors))

    @property
    def stated_errors(self) -> tuple[str, ...]:
        """Names of the errors that the user states, in the order of the budget."""
        terms = [] if self.catalogue is None else [self.catalogue.catalogue().term()]
        return (*stated_names(terms), *(block.name for block in self.budget if block.stated))

    def user_terms(self, unit: str = "pix") -> tuple[UserTerm, ...]:
        """User's terms of the error budget that do not depend on position.

        `unit` is that of u and v.  Raises InputError if it is an angle and a term has no unit.
        """
        return tuple(
            UserTerm(
                b.name,
                b.kind,
                b.sigma_u,
                b.sigma_v,
                _unit_of(b, unit),
                said_by_user(b.source),
                included_in_scatter=b.included_in_scatter,
            )
            for b in self.budget
            if b.stated and b.sigma_u is not None and b.sigma_v is not None
        )

    def linear_terms(self, solution: Solution) -> tuple[ErrorTerm, ...]:
        """User's terms of the error budget with a single size: scale, rotation, mission terms."""
        return tuple(
            one_size_term(b.name, b.kind, b.sigma, solution, said_by_user(b.source))
            for b in self.budget
            if b.sigma is not None
        )

    def in_residuals(self, unit: str = "pix") -> tuple[UserTerm, ...]:
        """User's terms included in the scatter of the residuals; `unit` is that of u and v."""
        return tuple(term for term in self.user_terms(unit) if term.included_in_scatter)

    def held_in_residuals(self, unit: str) -> list[tuple[str, float, float]]:
        """Name and sigma per axis, in the unit of u and v, of terms included in the residuals."""
        scale = self.detector.scale_mas
        return [(t.name, *t.sigma(unit, scale)) for t in self.in_residuals(unit)]

    def requirements(self) -> tuple[Requirement, ...]:
        """Requirements; those without a region apply to the field of the detector."""
        return self.within_field(Requirement(**r.model_dump()) for r in self.requirement)

    @property
    def field(self) -> Region:
        """Part of the detector that sees the sky."""
        block = self.detector.field
        if block is None:
            return WHOLE
        circle = block.model_dump() if isinstance(block, Circle) else block
        return check_region(circle, "detector.field")

    def within_field(self, requirements: Iterable[Requirement]) -> tuple[Requirement, ...]:
        """Requirements with the field of the detector in place of a missing region."""
        return tuple(
            replace(requirement, region=self.field) if requirement.region == WHOLE else requirement
            for requirement in requirements
        )


class StarsConfig(RunConfig):
    """Configuration whose stars are fitted like matched stars; a base for kinds of other packages.

    Subclasses add the section that the run begins with, and define `kind`, `title` and
    `named_files`.
    """

    tables: ClassVar[TablesBlock] = TablesBlock()
    periods: ClassVar[None] = None
    prior: ClassVar[tuple[PriorBlock, ...]] = ()
    prior_calibration: ClassVar[None] = None

    model: MatchedModel
    fit: Fit = Fit()
    outliers: Outliers = Outliers()
    sampler: Sampler = Sampler()
    compute: ComputeBlock = ComputeBlock()
    holdout: HoldoutBlock | None = None
    products: MatchedProducts = MatchedProducts()


def _unit_of(block: BudgetBlock, unit: str) -> str:
    """Unit of the sizes of a [[budget]] row; a size of zero needs no unit."""
    if not (block.sigma_u or block.sigma_v):
        return block.unit or "pix"
    return stated_unit(block.unit, unit, f"budget term {block.name!r}")


# -- files of other runs that a configuration uses -------------------------------------------------


def tables_file(path: Path) -> Path:
    """File of a detector's tables: the D2IMFILE itself, or the file in a run."""
    return path if path.is_file() else _file_of_run(path, TABLES, "tables.detector")


def rates_file(folder: Path) -> Path:
    """File of the posterior of a run that provides the drift."""
    return _file_of_run(folder, POSTERIOR, "model.tdd.rates")


def calibration_file(path: Path) -> Path:
    """Path of an earlier calibration: a file, or the posterior in the folder of a run."""
    return path if path.is_file() else _file_of_run(path, POSTERIOR, "prior_calibration.source")


def previous_file(path: Path) -> Path:
    """File of the release to be replaced: the file itself, or the posterior of a run."""
    return path if path.is_file() else _file_of_run(path, POSTERIOR, "products.previous")


def _file_of_run(folder: Path, name: str, key: str) -> Path:
    if not (folder / name).exists():
        raise InputError(
            f"has no {name}" if folder.is_dir() else "is not there",
            where=str(folder),
            do=f"name a finished run in {key}",
        )
    return folder / name
