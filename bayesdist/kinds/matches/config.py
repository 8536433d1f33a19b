"""Configuration of a run that begins with matched stars, and of the reading of its files.

The section [data] of a mission format may have additional keys; its class is derived from `Data`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    Field,
    PositiveFloat,
    PositiveInt,
    SerializeAsAny,
    ValidationInfo,
    WrapValidator,
    field_validator,
)

from bayesdist.app.config.fit import (
    ComputeBlock,
    Fit,
    HoldoutBlock,
    MatchedModel,
    Outliers,
    Periods,
    PriorBlock,
    PriorCalibrationBlock,
    Sampler,
    TablesBlock,
)
from bayesdist.app.config.results import MatchedProducts
from bayesdist.app.config.run import RunConfig, calibration_file
from bayesdist.app.config.section import (
    Epoch,
    RightAscensionDeclination,
    Section,
    Unit,
    names_nominal,
)
from bayesdist.data import FORMATS
from bayesdist.data.batches import BATCH
from bayesdist.data.formats import mission_formats
from bayesdist.data.tables.column import length_advice
from bayesdist.errors import InputError
from bayesdist.infer.compare.periods import check_periods, mjd_periods
from bayesdist.plugin import mission_objects

LENGTHS = ("mm", "um")  # units that a plate scale converts to arcsec


class Data(Section):
    """Matched stars, and options for reading their files."""

    matches: str | list[str]
    format: str = "auto"
    columns: dict[str, str] | None = None
    unit: Unit | Literal["mm", "um"] | None = None
    plate_scale: PositiveFloat | None = None  # arcsec per mm
    sigma: Literal["columns", "by_magnitude"] | PositiveFloat = "columns"
    pixel_origin: Literal[0, 1] | None = None
    tangent_point: RightAscensionDeclination | None = None
    epoch: Epoch | str | None = None
    catalogue_epoch: Epoch | None = None
    motion_prior: PositiveFloat | None = None  # mas per year
    not_finite: Literal["refuse", "reject"] = "refuse"
    same_position: Literal["one_star", "separate_stars"] = "one_star"
    rows_in_memory: PositiveInt = BATCH
    simulated: bool = False

    one_array: ClassVar[bool] = False  # True if matches of this format are from a single chip

    @property
    def has_nominal(self) -> bool:
        """True if columns of nominal positions are named."""
        return names_nominal(self.columns)

    def paths(self, base: Path) -> Path | list[Path]:
        """Files of matches; a single path, which may be a pattern, if one name is given."""
        if isinstance(self.matches, str):
            return base / self.matches
        return [base / name for name in self.matches]

    @field_validator("unit", mode="before")
    @classmethod
    def _no_length(cls, unit: Any) -> Any:
        advice = length_advice(unit) if isinstance(unit, str) else ""
        if advice and unit not in LENGTHS:
            raise ValueError(
                f"data.unit is {unit!r}, but positions are in pixels or angles; {advice}"
            )
        return unit

    def faults(self) -> Iterator[str]:
        """Faults of lengths without a plate scale, and of nominal positions outside of tables."""
        if self.unit in LENGTHS and self.plate_scale is None:
            yield (
                f"data.unit is {self.unit!r}, but positions are in pixels or angles; "
                f"{length_advice(str(self.unit))}"
            )
        if self.has_nominal and self.format not in ("auto", "table"):
            yield (
                f"nominal positions are columns of tables, but data.format is {self.format!r}; "
                "leave out u_nominal and v_nominal"
            )


def data_sections() -> dict[str, type[Data]]:
    """Section classes of formats that have additional keys, by format name."""
    return mission_objects(lambda mission: mission.data_sections)


def _of_its_format(raw: Any, handler: Any, info: ValidationInfo) -> Data:
    """Validate a section [data] as the class of its format."""
    if isinstance(raw, Data):
        return raw
    if not isinstance(raw, Mapping) or not isinstance(raw.get("format", ""), str):
        return handler(raw)
    format = raw.get("format", "auto")
    kind = Data
    if format not in FORMATS or raw.keys() - Data.model_fields.keys():
        sections = data_sections()
        formats = (*FORMATS, *mission_formats(), *sections)
        if format not in formats:
            listed = ", ".join(map(repr, formats))
            raise ValueError(
                f"data.format is {format!r}, which is not a known format; give one of {listed}"
            )
        kind = sections.get(format, Data)
        for name, section in sections.items():
            for key in raw.keys() & section.model_fields.keys() - kind.model_fields.keys():
                raise ValueError(
                    f"data.{key} is given, but data.format is {format!r}; set the format to "
                    f"{name!r}, or leave out {key}"
                )
    if info.mode == "json":  # in JSON mode arrays may become tuples
        return kind.model_validate_json(json.dumps(raw), strict=True)
    return kind.model_validate(raw)


DataOfFormat = Annotated[SerializeAsAny[Data], WrapValidator(_of_its_format)]


class MatchesConfig(RunConfig):
    """Configuration of a run that begins with matched stars."""

    kind: ClassVar[str] = "bayesdist.kinds.matches.kind:MATCHES"
    title: ClassVar[str] = "matched stars"
    begins_with: ClassVar[str] = "fit"
    tables: ClassVar[TablesBlock] = TablesBlock()

    data: DataOfFormat
    model: MatchedModel
    fit: Fit = Fit()
    outliers: Outliers = Outliers()
    sampler: Sampler = Sampler()
    compute: ComputeBlock = ComputeBlock()
    periods: Periods | None = None
    holdout: HoldoutBlock | None = None
    prior: list[PriorBlock] = Field(default_factory=list)
    prior_calibration: PriorCalibrationBlock | None = None
    products: MatchedProducts = MatchedProducts()

    def named_files(self, base: Path) -> Path | list[Path]:
        """Files of matches; a single path if one name is given."""
        return self.data.paths(base)

    def files_of_priors(self, base: Path) -> list[Path]:
        """File of the earlier calibration that is used as a prior, if any."""
        block = self.prior_calibration
        return [] if block is None else [calibration_file(base / block.source)]

    def of_order(self, order: int) -> Self:
        """Configuration with polynomials of another order, without priors and extra weights.

        Priors are dropped because they may name parameters that another order does not have.
        """
        fit = self.fit.model_copy(update={"radial_weight": 1.0})
        return (
            super()
            .of_order(order)
            .model_copy(update={"prior": [], "prior_calibration": None, "fit": fit})
        )

    def faults(self) -> Iterator[str]:
        """Faults of any run, and contradictory settings of matched stars."""
        yield from super().faults()
        names = [block.parameter for block in self.prior]
        duplicate = next((name for name in names if names.count(name) > 1), None)
        if duplicate is not None:
            yield f"two [[prior]] blocks are for {duplicate!r}; give at most one for each parameter"
        if self.data.one_array and self.chip:
            yield (
                f"matches in the format {self.data.format!r} are on one array; give "
                "detector.size in place of [[chip]] blocks"
            )
        by = self.outliers.jitter_by
        if by != "auto" and self.data.sigma == "by_magnitude":
            yield (
                f"outliers.jitter_by is {by!r}, which applies to quoted errors, but data.sigma = "
                "'by_magnitude' takes the errors of both axes from the residuals; leave it out, "
                "or give columns of errors or a number"
            )
        if by == "chip" and not self.chip:
            yield (
                "outliers.jitter_by is 'chip', but there is only one chip; leave it out, or give "
                "[[chip]] blocks"
            )
        if self.data.has_nominal and self.outliers.match_radius is not None:
            yield from self.circle_faults()
        if self.prior_calibration is not None and self.fit.radial_weight != 1.0:
            yield (
                "fit.radial_weight increases the weight of stars, but not that of the calibration "
                "in [prior_calibration]; leave one of the two out"
            )
        if self.periods is None:
            return
        if self.model.frames != "none" or self.model.tdd is not None:
            key = "tdd" if self.model.tdd is not None else "frames"
            yield (
                f"[periods] compares polynomials only, but model.{key} is given; drop one of them"
            )
        if (self.data.columns or {}).get("epoch") == "":
            yield (
                "[periods] needs an epoch for every pair, but data.columns leaves out the epoch; "
                "name its column there"
            )

    @property
    def compares_jitters(self) -> bool:
        """True if groups of stars may have separate jitters, if the data support it."""
        quoted = self.data.sigma != "by_magnitude"
        return quoted and self.outliers.jitter == "fit" and self.outliers.jitter_by != "one"

    def circle_faults(self) -> Iterator[str]:
        """Faults of settings that contradict matching in circles about nominal positions."""
        cut = "matches with nominal positions and a match radius are cut by the match circle"
        if self.data.sigma == "by_magnitude":
            yield (
                f"{cut}, and so are residuals, from which data.sigma = 'by_magnitude' takes the "
                "errors; give columns of errors, or a number"
            )
        if self.outliers.jitter_by not in ("auto", "one"):
            yield (
                f"{cut}, and so are residuals, from which outliers.jitter_by takes the jitters of "
                "groups; leave it out"
            )
        if self.holdout is not None:
            yield (
                f"{cut}, which the prediction of [holdout] does not know; leave [holdout] out, or "
                "the nominal positions"
            )
        if self.periods is not None:
            yield (
                f"{cut}, which draws the least-squares fits of [periods] to the nominal solution; "
                "leave [periods] out, or the nominal positions"
            )

    def spans(self) -> dict[str, tuple[float, float]]:
        """Start and end of each period in decimal years; empty if there are none."""
        if self.periods is None:
            return {}
        centres = self.periods.centres
        duplicate = next((c for c in centres if centres.count(c) > 1), None)
        if duplicate is not None:
            raise InputError(
                f"the period centred on {duplicate:.10g} is given twice",
                where="periods.centres",
                do="give each once",
            )
        spans = mjd_periods(centres, self.periods.days)
        check_periods(spans)
        return spans
