"""What a report is made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.checks import Check, warnings_of
from bayesdist.numbers import MISSING, count, with_mas
from bayesdist.report.mosaic import Mosaic

if TYPE_CHECKING:
    from astropy.table import Table

    from bayesdist.assess import (
        AreaMap,
        BinnedResiduals,
        ExposureSums,
        Margin,
        StarSample,
        UncertaintyMap,
        VectorMap,
    )
    from bayesdist.assess.budget.budget import ErrorBudget
    from bayesdist.assess.budget.surface import BudgetSurface
    from bayesdist.assess.requirements.validity import Horizon
    from bayesdist.data import MagnitudeErrors
    from bayesdist.diagnose import ScoreTest
    from bayesdist.diagnose.holdout.validation import HeldOutTruth
    from bayesdist.diagnose.periods import TimeVariation
    from bayesdist.infer import LinearFit, Posterior
    from bayesdist.infer.catalogue.added_errors import GroupedErrors
    from bayesdist.model import Chip
    from bayesdist.report.campaign import CampaignResults

__all__ = ["ChipResults", "Product", "ReportInput", "SelfcalResults", "campaign_of"]

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Product:
    """A file that the run wrote.

    Parameters
    ----------
    path : str
        Relative to the run's folder.
    what : str
    checks : tuple of Check
        What was verified on the file as written, its closure for one.
    """

    path: str
    what: str
    checks: tuple[Check, ...] = ()


@dataclass(frozen=True, eq=False)
class ChipResults:
    """What was assessed on one chip.

    Parameters
    ----------
    chip : Chip
    formal_map : UncertaintyMap
        Of the least-squares fit.
    posterior_map : UncertaintyMap or None
    displacement : VectorMap
        The distortion with its zeroth order suppressed.
    non_linear : VectorMap
    area : AreaMap
    binned : BinnedResiduals
    place : tuple of int
        Row (0 on top) and column of the chip among the others.
    relative_map : UncertaintyMap or None
        Of the posterior's relative positions, where the gauge is a question.
    """

    chip: Chip
    formal_map: UncertaintyMap
    posterior_map: UncertaintyMap | None
    displacement: VectorMap
    non_linear: VectorMap
    area: AreaMap
    binned: BinnedResiduals
    place: tuple[int, int] = (0, 0)
    relative_map: UncertaintyMap | None = None

    @property
    def maps(self) -> tuple[UncertaintyMap, ...]:
        """The two uncertainty maps that are shown, or one where there is no other.

        Least squares and posterior; or posterior and relative positions, where there are such.
        """
        known = (self.formal_map, self.posterior_map, self.relative_map)
        return tuple(m for m in known if m is not None)[-2:]

    @property
    def best_map(self) -> UncertaintyMap:
        """That of the posterior where there is one."""
        return self.formal_map if self.posterior_map is None else self.posterior_map


@dataclass(frozen=True, eq=False)
class SelfcalResults:
    """What a run without a catalogue adds.

    Parameters
    ----------
    words : str
        In which gauge everything stands.
    gauge : astropy.table.Table
        As gauge.ecsv.
    matching : astropy.table.Table
        One row for each exposure.
    stars : astropy.table.Table
        As stars.ecsv.
    outlines : tuple of ndarray, each (M, 2)
        Closed outline of each chip in each exposure, on the sky.
    held : tuple of str
        Parameters that the gauge holds.
    summary : mapping
        As in summary.json.
    """

    words: str
    gauge: Table
    matching: Table
    stars: Table
    outlines: tuple[Float, ...]
    held: tuple[str, ...]
    summary: Mapping[str, Any]


@dataclass(frozen=True)
class Words:
    """Words of a report.

    Parameters
    ----------
    things : str
        What is fitted, one row each.
    all_things : str
        These as they come into the fit.
    false : str
        Rows that are none of them.
    chooser : str
        What leaves out rows that are far off: the sampling does not.
    fit : str
        What the parameters are from before they are sampled.
    holder : str
        What holds parameters that the data say nothing of.
    taken : str
        What makes residuals smaller than errors, as a clause; empty where nothing does.
    """

    things: str
    all_things: str
    false: str
    chooser: str
    fit: str
    holder: str
    taken: str = ""


MATCHED = Words(
    things="stars",
    all_things="matched stars",
    false="false matches",
    chooser="least-squares fit",
    fit="linear fit",
    holder="a prior",
)
DETECTED = Words(
    things="detections",
    all_things="detections of stars",
    false="false detections",
    chooser="limits of residuals",
    fit="solution",
    holder="the gauge",
    taken=", less what the fitted stars take of them",
)


@dataclass(frozen=True, eq=False)
class ReportInput:
    """Results of a run, as the report shows them.

    Parameters
    ----------
    name : str
        What was calibrated: the title.
    config : mapping
        The resolved configuration.
    stars : StarSample
        All stars or, of very many, some: the only ones that are drawn one by one.
    exposures : ExposureSums
        Of all stars, at the least-squares fit.
    fit : LinearFit
    posterior : Posterior or None
        None where nothing was sampled: the report then says that errors are formal ones only.
    chips : tuple of ChipResults
        In the order of the model's chips.
    coefficients : astropy.table.Table
        Legendre coefficients and all other parameters; columns name, chip, axis, i, j, value,
        sigma (least squares), mean, sd, lo68, hi68, lo95, hi95, rhat, ess_bulk, unit.  Those of the
        posterior may be missing or masked.
    budget : ErrorBudget or None
    surface : BudgetSurface or None
        The same budget at every position and epoch, for the page to compute from.
    margins : tuple of Margin
    horizons : tuple of Horizon
        Until when requirements are met; empty where nothing depends on time.
    products : tuple of Product
    checks : tuple of Check
        All criteria and remarks but those of requirements and products.
    score_tests : tuple of ScoreTest
        What the residuals were asked, and what they say.
    magnitude_errors : MagnitudeErrors or None
        Errors by magnitude, where the stars carried none.
    added_errors : GroupedErrors or None
        Errors beyond the quoted ones by groups of stars, where these were compared.
    flagged : ndarray of int, shape (E,), or None
        Stars of each exposure that are more likely false matches than not.
    provenance : mapping
        Versions, seed, hashes of the input, timings, command; mappings may be nested.
    campaign : CampaignResults or None
        What a run that began with star lists adds.
    periods : TimeVariation or None
        Models of several periods compared, where that was asked for.
    held_out : HeldOutTruth or None
        What stars say that were set aside before the fit, where there are any.
    selfcal : SelfcalResults or None
        What a run without a catalogue adds.
    """

    name: str
    config: Mapping[str, Any]
    stars: StarSample
    exposures: ExposureSums
    fit: LinearFit
    posterior: Posterior | None
    chips: tuple[ChipResults, ...]
    coefficients: Table
    budget: ErrorBudget | None = None
    surface: BudgetSurface | None = None
    margins: tuple[Margin, ...] = ()
    horizons: tuple[Horizon, ...] = ()
    products: tuple[Product, ...] = ()
    checks: tuple[Check, ...] = ()
    score_tests: tuple[ScoreTest, ...] = ()
    magnitude_errors: MagnitudeErrors | None = None
    added_errors: GroupedErrors | None = None
    flagged: NDArray[np.int64] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    campaign: CampaignResults | None = None
    periods: TimeVariation | None = None
    held_out: HeldOutTruth | None = None
    selfcal: SelfcalResults | None = None

    @property
    def unit(self) -> str:
        """Unit of u and v."""
        return self.fit.model.unit

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences that belong on top."""
        return warnings_of(self.checks)

    @property
    def words(self) -> Words:
        """What things are called."""
        return MATCHED if self.selfcal is None else DETECTED

    @property
    def sample(self) -> str:
        """'a sample of 200 000 of 11 213 542 stars'; empty where all stars are shown."""
        if not self.stars.partial:
            return ""
        some, every = count(len(self.stars)), count(self.stars.n_total)
        return f"a sample of {some} of {every} {self.words.things}"

    @property
    def provisional(self) -> bool:
        """Whether what the sampler gave must not be relied on."""
        return self.posterior is not None and not self.posterior.convergence.converged

    @property
    def solution(self) -> LinearFit | Posterior:
        """The posterior where there is one, else the fit."""
        return self.fit if self.posterior is None else self.posterior

    @property
    def mosaic(self) -> Mosaic:
        """How the chips lie."""
        return Mosaic.of_chips([c.chip for c in self.chips], [c.place for c in self.chips])

    @property
    def several(self) -> bool:
        """Whether the detector has more than one chip."""
        return len(self.chips) > 1

    def length(self, value: float) -> str:
        """A length in the unit of u and v, and in mas where the size of a pixel is known."""
        return with_mas(value, self.unit, self.scale_mas)

    def marked(self, text: str) -> str:
        """A number that rests on the sampler, with a dagger where that did not converge."""
        return f"{text}\u202f†" if self.provisional and text != MISSING else text

    def on_chip(self, chip: Chip) -> str:
        """' of WFC1' where there are several chips, else nothing."""
        return f" of {chip.name}" if self.several else ""

    @property
    def held(self) -> frozenset[str]:
        """Parameters that a prior or the gauge holds: they are no measurements."""
        if self.selfcal is not None:
            return frozenset(self.selfcal.held)
        return frozenset(() if self.campaign is None else self.campaign.held)

    @property
    def scale_mas(self) -> float | None:
        """Size of a pixel in mas, where the configuration gives it."""
        value = self.config.get("detector", {}).get("scale_mas")
        return None if value is None else float(value)

    def setting(self, section: str, key: str, default: Any) -> Any:
        """A value of the resolved configuration."""
        return self.config.get(section, {}).get(key, default)

    def sampled_mean(self, key: str) -> float:
        """Posterior mean of 'f', 'j' or 's_out'; 0 where it was not sampled."""
        if self.posterior is None or key not in self.posterior.hyper:
            return 0.0
        return float(np.mean(self.posterior.hyper[key]))


def campaign_of(r: ReportInput) -> CampaignResults:
    """What a campaign adds, of a run that has it."""
    assert r.campaign is not None
    return r.campaign
