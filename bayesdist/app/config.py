"""The configuration file: every key, its type and its default."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)

from bayesdist.app.campaign.config import CampaignBlock, ReleaseBlock, TablesBlock
from bayesdist.app.config_errors import as_config_error
from bayesdist.app.section import Section
from bayesdist.assess import Requirement, UserTerm
from bayesdist.errors import ConfigError, InputError
from bayesdist.infer import Compute, OutlierMixture
from bayesdist.model import FRAME_KINDS, Chip, TimeDependence

__all__ = ["Config", "load_config", "load_requirements", "load_text", "parse_config"]

Pair = tuple[PositiveFloat, PositiveFloat]
Unit = Literal["pix", "arcsec", "mas", "deg"]
Probability = Annotated[float, Field(gt=0, lt=1)]


class Data(Section):
    """What is read, and how."""

    matches: str | list[str]
    format: Literal["auto", "table", "hst1pass", "matchup", "astrometry.net"] = "auto"
    columns: dict[str, str] | None = None
    unit: Unit | None = None
    sigma: Literal["columns", "by_magnitude"] | PositiveFloat = "columns"
    pixel_origin: Literal[0, 1] = 1
    tangent_point: tuple[float, float] | None = None


class Detector(Section):
    """A detector of one chip."""

    name: str = ""
    size: Pair | None = None
    scale_mas: PositiveFloat | None = None


class ChipBlock(Section):
    """One of several chips."""

    number: int
    name: str
    size: Pair
    reference_pixel: Pair
    reference: bool = False


class Tdd(Section):
    """Terms that drift linearly with time."""

    epoch0: float | list[float]
    terms: list[tuple[Literal["u", "v"], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]]
    breaks: list[float] = Field(default_factory=list)
    rates: str = "free"


class ModelBlock(Section):
    """Structure of the distortion model."""

    order: Annotated[int, Field(ge=1, le=9)]
    reference_pixel: Pair | None = None
    frames: Literal[FRAME_KINDS] = "none"  # type: ignore[valid-type]
    tdd: Tdd | None = None


class Fit(Section):
    """The linear fit."""

    clip_chi2: PositiveFloat = 25.0
    clip_abs: PositiveFloat = 2.0
    radial_weight: PositiveFloat = 1.0


class Outliers(Section):
    """The outlier mixture."""

    model: Literal["gaussian", "uniform", "none"] = "gaussian"
    match_radius: PositiveFloat | None = None
    jitter: Literal["fit"] | Annotated[float, Field(ge=0)] = "fit"
    fraction_prior: Pair = (1.0, 9.0)


class Sampler(Section):
    """When to stop, and from which seed."""

    method: Literal["exact", "certified"] = "exact"
    second_stage: Literal["auto", "always", "never"] = "auto"
    seed: Annotated[int, Field(ge=0)] = 1
    ensembles: Annotated[int, Field(ge=2)] = 4
    walkers: PositiveInt | None = None
    target_ess: PositiveFloat = 400.0
    target_rhat: Annotated[float, Field(gt=1)] = 1.01
    max_steps: PositiveInt = 20_000
    checkpoint_every: PositiveInt = 200


class ComputeBlock(Section):
    """Where the work is done."""

    engine: Literal["threads", "dask"] = "threads"
    scheduler: str | None = None
    workers: PositiveInt | None = None
    memory_mb: PositiveFloat = 1000.0

    @model_validator(mode="after")
    def _only_of_a_cluster(self) -> ComputeBlock:
        for key in ("scheduler", "workers"):
            if self.engine != "dask" and getattr(self, key) is not None:
                raise ValueError(
                    f"compute.{key} is given, but compute.engine is {self.engine!r}; set the "
                    f"engine to 'dask', or leave {key} out"
                )
        if self.scheduler is not None and self.workers is not None:
            raise ValueError(
                "compute.workers is given, but the cluster of compute.scheduler has its own; "
                "leave one of the two out"
            )
        return self


class Assess(Section):
    """Where and when errors are assessed."""

    epoch: float | None = None
    grid: tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]] = (33, 17)
    draws: Annotated[int, Field(ge=100)] = 4000


class BudgetBlock(Section):
    """An error term that the data cannot show."""

    name: str
    kind: Literal["random", "systematic"]
    sigma_u: Annotated[float, Field(ge=0)]
    sigma_v: Annotated[float, Field(ge=0)]
    unit: Unit = "pix"


class RequirementBlock(Section):
    """A limit on a statistic of the position error."""

    name: str
    statistic: str
    limit: PositiveFloat
    unit: Unit = "pix"
    probability: Probability = 0.95
    epoch: float | None = None
    chip: int | None = None


class PriorBlock(Section):
    """A Gaussian prior on one parameter."""

    parameter: str
    mean: float
    sigma: PositiveFloat


class Sip(Section):
    """A SIP header."""

    inverse_order: Annotated[int, Field(ge=2, le=9)] | None = None
    linear: Literal["cd", "sip"] = "cd"
    crval: tuple[float, float] = (0.0, 0.0)


class Idctab(Section):
    """An IDCTAB reference file."""

    instrument: str
    detector: str
    v2v3: Literal["aperture"] = "aperture"
    v2ref: float = 0.0
    v3ref: float = 0.0
    vafactor: PositiveFloat = 1.0
    filters: list[str] | list[list[str]] | None = None
    useafter: str | None = None
    pedigree: str | None = None


class Products(Section):
    """Files for pipelines."""

    sip: Sip | None = None
    idctab: Idctab | None = None
    release: ReleaseBlock | None = None


class Config(Section):
    """The whole file."""

    data: Data | None = None
    campaign: CampaignBlock | None = None
    tables: TablesBlock = TablesBlock()
    model: ModelBlock
    detector: Detector = Detector()
    chip: list[ChipBlock] = Field(default_factory=list)
    fit: Fit = Fit()
    outliers: Outliers = Outliers()
    sampler: Sampler = Sampler()
    compute: ComputeBlock = ComputeBlock()
    assess: Assess = Assess()
    budget: list[BudgetBlock] = Field(default_factory=list)
    requirement: list[RequirementBlock] = Field(default_factory=list)
    prior: list[PriorBlock] = Field(default_factory=list)
    products: Products = Products()

    @model_validator(mode="after")
    def _data_or_campaign(self) -> Config:
        if (self.data is None) == (self.campaign is None):
            raise ValueError(
                "a run begins with [data], matched stars, or with [campaign], star lists; give one"
            )
        if self.campaign is None and self.products.release is not None:
            raise ValueError("products.release is of a [campaign]; ask for sip or idctab")
        if self.campaign is None and self.tables.detector is not None:
            raise ValueError("tables.detector is of a [campaign]; leave it out")
        if self.campaign is None and self.model.tdd is not None and self.model.tdd.rates != "free":
            raise ValueError("model.tdd.rates is of a [campaign]; give [[prior]] blocks")
        if self.campaign is not None and self.model.frames != "none":
            raise ValueError("a [campaign] has frames of its own; leave model.frames out")
        if self.campaign is not None and len(self.chip) == 0:
            raise ValueError("a [campaign] has no [[chip]] blocks; give them, one as the reference")
        return self

    @model_validator(mode="after")
    def _chips_or_detector(self) -> Config:
        if sum(c.reference for c in self.chip) > 1:
            raise ValueError("reference = true stands in several [[chip]] blocks; keep it in one")
        for key in ("number", "name"):
            values = [getattr(c, key) for c in self.chip]
            twice = next((v for v in values if values.count(v) > 1), None)
            if twice is not None:
                raise ValueError(f"two [[chip]] blocks have the {key} {twice!r}; give each its own")
        if self.chip and (self.detector.size or self.model.reference_pixel):
            raise ValueError(
                "[[chip]] blocks stand in place of detector.size and model.reference_pixel; "
                "give one of the two"
            )
        if not self.chip and self.detector.size is None:
            raise ValueError("detector.size is missing; give it, or [[chip]] blocks")
        return self

    def chips(self) -> tuple[Chip, ...]:
        """Chips of the model; empty for a detector of one chip."""
        # the reference chip stands first: it defines the frame
        blocks = sorted(self.chip, key=lambda c: not c.reference)
        return tuple(Chip(c.number, c.name, c.size, c.reference_pixel) for c in blocks)

    def time(self) -> TimeDependence | None:
        """Time dependence of the model."""
        tdd = self.model.tdd
        if tdd is None or not tdd.terms:
            return None
        epochs = tdd.epoch0 if isinstance(tdd.epoch0, list) else [tdd.epoch0]
        return TimeDependence(tuple(tdd.terms), tuple(epochs), tuple(tdd.breaks))

    def mixture(self) -> OutlierMixture:
        """The outlier mixture."""
        o = self.outliers
        return OutlierMixture(
            model=o.model,
            match_radius=o.match_radius,
            jitter=None if o.jitter == "fit" else o.jitter,
            fraction_prior=o.fraction_prior,
        )

    def resources(self) -> Compute:
        """Where the work is done."""
        return Compute(**self.compute.model_dump())

    def user_terms(self) -> tuple[UserTerm, ...]:
        """The user's terms of the error budget."""
        return tuple(UserTerm(**b.model_dump()) for b in self.budget)

    def requirements(self) -> tuple[Requirement, ...]:
        """The requirements."""
        return tuple(Requirement(**r.model_dump()) for r in self.requirement)


class _RequirementFile(Section):
    requirement: Annotated[list[RequirementBlock], Field(min_length=1)]


def load_config(path: str | Path) -> tuple[Config, str]:
    """Read a configuration file.

    Parameters
    ----------
    path : path

    Returns
    -------
    config : Config
    text : str
        The file as it stands.

    Raises
    ------
    ConfigError
        With file, key and reason; an unknown key names the nearest known one.
    """
    text = load_text(path)
    return parse_config(text, str(path)), text


def parse_config(text: str, where: str) -> Config:
    """A configuration from the text of a file; `where` names it in errors."""
    config = _validated(Config, text, where)
    try:
        config.time()
        config.mixture()
        config.user_terms()
        config.requirements()
    except InputError as error:
        raise ConfigError(error.cause, where=f"{where}: {error.where}", do=error.do) from error
    return config


def load_requirements(path: str | Path) -> tuple[Requirement, ...]:
    """Read a file of ``[[requirement]]`` blocks.

    Raises
    ------
    ConfigError
    """
    blocks = _validated(_RequirementFile, load_text(path), str(path)).requirement
    try:
        return tuple(Requirement(**r.model_dump()) for r in blocks)
    except InputError as error:
        raise ConfigError(error.cause, where=f"{path}: {error.where}", do=error.do) from error


def load_text(path: str | Path) -> str:
    """Text of a file as it stands, with its line ends.

    Raises
    ------
    ConfigError
    """
    try:
        with open(path, encoding="utf-8", newline="") as stream:
            return stream.read()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(
            f"cannot be read ({reason})", where=str(path), do="check the path and the file"
        ) from error


def _validated(kind: type[Section], text: str, where: str) -> Any:
    try:
        raw = tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            f"is not valid TOML ({error})", where=where, do="correct it there"
        ) from error
    try:
        # by way of JSON: there arrays may become tuples, but no text a number
        return kind.model_validate_json(json.dumps(raw, default=str), strict=True)
    except ValidationError as error:
        raise as_config_error(kind, error, where) from error
