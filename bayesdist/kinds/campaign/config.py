"""Configuration of a campaign, which begins with star lists and a catalogue."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import PositiveFloat

from bayesdist.app.config.fit import (
    BaseFit,
    BaseTdd,
    ComputeBlock,
    HoldoutBlock,
    MixtureOutliers,
    PriorBlock,
    Sampler,
    StructureBlock,
    TablesBlock,
)
from bayesdist.app.config.results import ProductsBlock, ReleaseBlock, with_formats
from bayesdist.app.config.run import FREE, RunConfig, rates_file, tables_file
from bayesdist.app.config.section import Epoch, Unit
from bayesdist.kinds.star_lists import StarListsBlock


class CampaignBlock(StarListsBlock):
    """Star lists, the catalogue to match them with, and properties of the exposures."""

    catalog: str
    exposures: str
    initial_distortion: str
    catalog_columns: dict[str, str] | None = None
    unit: Unit | None = None
    catalogue_epoch: Epoch | None = None
    motion_prior: PositiveFloat | None = None  # mas per year
    parity: Literal["auto", "direct", "mirrored"] = "auto"
    filter: str | None = None
    radius: PositiveFloat | None = None
    pm_selection: Literal["reliable", "all"] = "reliable"
    vafactor_source: Literal["log", "earth"] = "log"
    sigma: Literal["measured", "columns"] = "measured"


class CampaignTdd(BaseTdd):
    """Terms that drift linearly with time, optionally at the rates of another run."""

    rates: str = "free"


class CampaignModel(StructureBlock):
    """Structure of the distortion model; a campaign defines the frames of its exposures itself."""

    frames: ClassVar[Literal["none"]] = "none"

    tdd: CampaignTdd | None = None


class CampaignFit(BaseFit):
    """Linear fit of a campaign."""

    radial_weight: ClassVar[float] = 1.0


class CampaignOutliers(MixtureOutliers):
    """Outlier mixture of a campaign."""

    jitter_by: ClassVar[Literal["auto"]] = "auto"


@with_formats()
class CampaignProducts(ProductsBlock):
    """Products of a campaign, with a release for several filters."""

    release: ReleaseBlock | None = None


class CampaignConfig(RunConfig):
    """Configuration of a run that begins with star lists and a catalogue."""

    kind: ClassVar[str] = "bayesdist.kinds.campaign.kind:CAMPAIGN"
    title: ClassVar[str] = "star lists and a catalogue"
    is_dated: ClassVar[bool] = True
    periods: ClassVar[None] = None
    prior: ClassVar[tuple[PriorBlock, ...]] = ()
    prior_calibration: ClassVar[None] = None
    renamed: ClassVar[Mapping[str, str]] = {
        **RunConfig.renamed,
        "campaign.aberration": "vafactor_source",
        "campaign.motions": "pm_selection",
        "campaign.start": "initial_distortion",
        "tables.rounds": "max_iterations",
    }
    instead: ClassVar[Mapping[str, str]] = {
        "model.frames": "leave it out: a campaign has frames of its own",
        "prior": "leave it out: the scatter of the exposures is their prior",
        "prior_calibration": "leave it out: the scatter of the exposures is their prior",
    }

    campaign: CampaignBlock
    tables: TablesBlock = TablesBlock()
    model: CampaignModel
    fit: CampaignFit = CampaignFit()
    outliers: CampaignOutliers = CampaignOutliers()
    sampler: Sampler = Sampler()
    compute: ComputeBlock = ComputeBlock()
    holdout: HoldoutBlock | None = None
    products: CampaignProducts = CampaignProducts()

    def faults(self) -> Iterator[str]:
        """Configuration errors that any run can have, and one if there are no [[chip]] blocks."""
        yield from super().faults()
        if not self.chip:
            yield "a [campaign] needs [[chip]] blocks; give them, one of them with reference = true"

    def named_files(self, base: Path) -> list[Path]:
        """Lists, catalogue and log, and files taken over from other runs."""
        block, tdd = self.campaign, self.model.tdd
        named = [block.catalog, block.exposures, block.initial_distortion, *block.list_names]
        files = [base / name for name in dict.fromkeys(named)]
        if self.tables.detector is not None:
            files.append(tables_file(base / self.tables.detector))
        if tdd is not None and tdd.rates != FREE:
            files.append(rates_file(base / tdd.rates))
        return files

    @property
    def fits_on_grid(self) -> bool:
        """True if the fit writes errors of tables on the grid of the assessment."""
        return self.tables.method != "none" or self.tables.detector is not None

    @property
    def filter_name(self) -> str:
        """Filter of the exposures, if the settings name it; may be empty."""
        return self.detector.filter or self.campaign.filter or ""

    @property
    def named_detector(self) -> str:
        """Empty, because formats for a single detector do not list those of campaigns by name."""
        return ""
