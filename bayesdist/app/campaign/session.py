"""What the stages of a campaign's run share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.holdout import predictive_of_campaign
from bayesdist.app.campaign.inputs import Inputs, read_inputs
from bayesdist.app.campaign.interpolation import interpolation_term
from bayesdist.app.campaign.outrun import refuse_outrun_stars
from bayesdist.app.campaign.reference import FREE, rate_priors
from bayesdist.app.campaign.systematics import (
    errors_by_star,
    kept_covariance,
    systematics_of,
    with_kept_stars,
)
from bayesdist.app.campaign.table_file import KeptTables, read_tables, write_tables
from bayesdist.app.config.campaign import CampaignBlock
from bayesdist.app.session import Session
from bayesdist.app.star_files import PAIRS
from bayesdist.app.systematics import Systematics
from bayesdist.assess import SAMPLE, LocalErrors
from bayesdist.assess.terms.forms import GIVEN, MEASURED
from bayesdist.data import MagnitudeErrors, MatchTable, read_matches, with_centroid_errors
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.infer import GaussianPriors, LinearFit, Matches, Posterior, fit_by_magnitude
from bayesdist.infer.discrepancy import Discrepancy, estimate_discrepancy
from bayesdist.infer.exposures.chip_offsets import Settling
from bayesdist.infer.nodes.alternation import inside_chips, on_the_chips, with_columns
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.infer.series import Series
from bayesdist.model import DistortionModel, LookupTable, corrected

__all__ = ["HIERARCHY", "TABLES", "TERMS", "CampaignSession"]

Float = NDArray[np.float64]

TABLES, HIERARCHY, TERMS = "tables.h5", "hierarchy.h5", "exposure_terms.h5"
_AGAIN = "run the stage 'fit' again"


@dataclass
class CampaignSession(Session):
    """What the stages share: pairs as matched, tables, scatter of the exposures, the fit."""

    @property
    def block(self) -> CampaignBlock:
        """The campaign's part of the configuration."""
        assert self.config.campaign is not None
        return self.config.campaign

    @property
    def base(self) -> Path:
        """Folder that the configuration's files are relative to."""
        return Path(self.run.record["base"])

    @property
    def reference_chip(self) -> int:
        """Number of the chip whose axes and zero point define the gauge."""
        return self.config.chips()[0].number

    @property
    def unit_arcsec(self) -> float:
        """Size of the catalogue's unit."""
        scale = {"arcsec": 1.0, "mas": 1e-3, "deg": 3600.0}.get(self.inputs.catalog.unit)
        return scale or (self.scale_arcsec or 0.05)

    @cached_property
    def inputs(self) -> Inputs:
        """Catalogue, exposures and star lists."""
        return read_inputs(self.block, self.base)

    @property
    def mirrored(self) -> bool:
        """Whether the pairs' u has the sign that is opposite to the catalogue's."""
        return bool(self.run.summary.get("matching", {}).get("parity") == "mirrored")

    @cached_property
    def _all_matches(self) -> MatchTable:  # type: ignore[override]
        """All pairs as matched, those that are held out among them."""
        return read_matches(self.run / PAIRS, unit=self.inputs.catalog.unit)

    @property
    def pairs(self) -> MatchTable:
        """Raw pixels beside aberration-neutral catalogue positions, with the catalogue's errors."""
        kept = self._all_matches if self._split is None else self._split.kept
        assert isinstance(kept, MatchTable)
        return kept

    @property
    def held_pairs(self) -> MatchTable | None:
        """The same of what is held out; None where nothing is."""
        held = None if self._split is None else self._split.held
        assert held is None or isinstance(held, MatchTable)
        return held

    needed_exposures = 1  # it defines the gauge

    @property
    def largest_vafactor(self) -> float:
        """By which the catalogue's errors are divided: all factors are nearly the same."""
        return float(self.inputs.log.values("vafactor").max())

    @cached_property
    def _kept_tables(self) -> KeptTables:
        return read_tables(self.run / TABLES, do=_AGAIN)

    @property
    def tables(self) -> tuple[LookupTable, ...]:
        """Look-up tables of an earlier stage: the detector's, and those of the filter."""
        return self._kept_tables.tables

    @property
    def structure_is_left(self) -> bool:
        """Not where the errors of tables stand for it."""
        return not self._kept_tables.position_sigma

    @cached_property
    def local_terms(self) -> tuple[LocalErrors, ...]:
        """What the errors of the tables leave of the position, and what lies between nodes."""
        kept, grid = self._kept_tables, self.config.assess.grid
        between = interpolation_term(kept.between, self.posterior, grid=grid, epoch=self.epoch)
        sigma, block = kept.position_sigma, self.config.tables
        if not sigma:
            return between
        source = MEASURED
        if block.detector is not None:
            given = f"{GIVEN}: errors of the detector's tables in {block.detector}"
            source = given if block.method == "none" else f"{MEASURED}, and {given}"
        tables = LocalErrors.on_grid("look-up tables", sigma, self.posterior.model, source)
        return (tables, *between)

    @property
    def between_nodes(self) -> Mapping[int, BetweenNodes]:
        """What the tables leave between their nodes, by chip, where it has been measured."""
        return self._kept_tables.between

    @property
    def published_tables(self) -> tuple[LookupTable, ...]:
        """The tables with the errors that a user meets: of the nodes, and of what lies between.

        What is between the nodes of a pattern is at the nodes too: the value of a table there is
        that of the area around.  It counts in the tables that were fitted in this run.
        """
        out, held = [], self.config.tables.detector is not None
        for table in self.tables:
            between = self.between_nodes.get(table.chip)
            if table.sigma is not None and between is not None and bool(table.filter) == held:
                whole = np.sqrt(table.sigma**2 + between.left.mean[:, None, None])
                table = replace(table, sigma=whole)
            out.append(table)
        return tuple(out)

    def keep_tables(
        self,
        tables: tuple[LookupTable, ...],
        position_sigma: Mapping[int, Float] | None = None,
        between: tuple[BetweenNodes, ...] = (),
    ) -> None:
        """Write tables, and their errors at nodes and between them, for the other stages."""
        write_tables(self.run / TABLES, tables, position_sigma, between)
        self.forget()

    @cached_property
    def raw_matches(self) -> Matches:
        """Pairs at the pixels that the tables have corrected."""
        return self._corrected(self.pairs)

    @property
    def held_matches(self) -> MatchTable | None:
        """What is held out, in the same way, with its errors; None where nothing is."""
        held, errors = self.held_pairs, self.magnitude_errors
        if held is None:
            return None
        held = self._corrected(held)
        return held if errors is None else with_centroid_errors(held, errors)

    @property
    def signed(self) -> Posterior:
        """The solution with the errors of the catalogue as `assess` has kept them."""
        posterior, found = with_kept_stars(self), self.discrepancy
        if found is None:
            return posterior
        return found.with_everything(posterior, kept_covariance(self))

    @cached_property
    def solution(self) -> Posterior:  # type: ignore[override]
        """What is exported and shown: all errors of the parameters are in its draws."""
        return self.signed

    @property
    def predictive(self) -> Predictive:
        """The posterior as it predicts what is held out."""
        return predictive_of_campaign(self)

    def _corrected(self, pairs: MatchTable) -> MatchTable:
        return on_the_chips(self._moved(pairs), self.plain_model) if self.tables else pairs

    def _moved(self, pairs: MatchTable) -> MatchTable:
        """Pairs at the pixels that the tables move them to."""
        x, y = corrected(
            self.tables, pairs.x, pairs.y, chip=pairs.chip_number, filter=self.inputs.filter
        )
        return with_columns(pairs, x=x, y=y)

    @property
    def inside_with_tables(self) -> NDArray[np.bool_]:
        """Boolean mask of the pairs that the tables do not move off their chip."""
        if not self.tables:
            return np.ones(len(self.pairs), bool)
        return inside_chips(self._moved(self.pairs), self.plain_model)

    def errors_by_magnitude(self, pairs: Matches) -> tuple[LinearFit, Matches, MagnitudeErrors]:
        """Fit of every exposure by itself and errors by magnitude, as `fit_by_magnitude`.

        Raises
        ------
        InputError
            Where stars have outrun a catalogue without proper motions.
        """
        found = fit_by_magnitude(pairs, self.plain_model)
        if isinstance(found[1], MatchTable):
            refuse_outrun_stars(self.inputs, found[0], found[1])
        return found

    @cached_property
    def magnitude_errors(self) -> MagnitudeErrors | None:
        """Errors of the centroids, as the fit left them."""
        return self.kept_errors()

    def estimate_discrepancy(self) -> Discrepancy:
        """What the model may leave out, beyond what the campaign's own hierarchy describes.

        Tables that were fitted in this run have taken the structure; their errors, and what they
        leave between their nodes, are terms of the budget.  The catalogue's errors are counted by
        star where it states them.
        """
        matches = self.matches
        assert isinstance(matches, MatchTable)
        stated = errors_by_star(self.inputs.catalog) is not None
        return estimate_discrepancy(
            self.shards,
            self.posterior,
            rng=self.rng("assess"),
            priors=self.config.discrepancy.priors(),
            parameter_priors=self.priors,
            sample=matches.sample(SAMPLE),
            stars=None if stated else matches,
            structure=self.config.tables.method == "none",
            exposures=False,
            settling=self.settling,
        )

    @property
    def tested_matches(self) -> MatchTable:
        """Matches with what the catalogue states of the motions of their stars."""
        table, catalog = super().tested_matches, self.inputs.catalog
        if table.star is None or catalog.pm_u is None or catalog.sigma_pm_u is None:
            return table
        columns = {}
        for name in ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"):
            by_code = np.zeros(int(catalog.star.max()) + 1)
            by_code[catalog.star] = getattr(catalog, name)
            columns[name] = by_code[table.star]
        return with_columns(table, **columns)

    @property
    def centroid(self) -> MagnitudeErrors | None:  # type: ignore[override]
        """The same: the catalogue's errors have been taken off, and what is left out at a place."""
        found = self.discrepancy
        return self.magnitude_errors if found is None else found.of_centroids(self.magnitude_errors)

    @cached_property
    def matches(self) -> Matches:
        """The same with the errors of centroid and catalogue."""
        raw, errors = self.raw_matches, self.magnitude_errors
        assert isinstance(raw, MatchTable)
        return raw if errors is None else with_centroid_errors(raw, errors)

    @cached_property
    def plain_model(self) -> DistortionModel:
        """The configured polynomial with a free linear part of each exposure.

        For tables and errors: whatever drifts or scatters in the linear terms is taken up.
        """
        return DistortionModel(
            self.config.model.order,
            self.config.chips(),
            unit=self.inputs.catalog.unit,
            frames="affine",
            exposures=self.pairs.exposure_names,
        )

    @cached_property
    def model(self) -> DistortionModel:
        """The model that was fitted."""
        return self.fit.model

    @cached_property
    def priors(self) -> GaussianPriors:
        """Of the deviations of the exposures, as the fit found them to scatter."""
        arrays = read_arrays(self.run / HIERARCHY, "", do=_AGAIN)
        return GaussianPriors(arrays["prior_centre"], arrays["prior_precision"])

    @property
    def catalogue_stated(self) -> bool:
        """Whether the catalogue has errors of its own, or a row of the budget names it."""
        return self.inputs.catalog.sigma_u is not None or bool(super().catalogue_stated)

    @property
    def motions_stated(self) -> bool:
        """Whether the catalogue has errors of its motions, or a row of the budget names them."""
        return self.inputs.catalog.sigma_pm_u is not None or bool(super().motions_stated)

    @property
    def further_caveats(self) -> tuple[str, ...]:
        """Deviations that go with time: no draw of the errors of a later exposure has that."""
        return tuple(self.run.summary.get("deviations", {}).get("warnings", ()))

    @property
    def doubts(self) -> list[str]:
        """What the stages found odd, and what the campaign cannot tell."""
        found = self.run.summary
        parts = ("matching", "deviations", "tables", "time_dependence")
        own = [text for part in parts for text in found.get(part, {}).get("warnings", [])]
        return [*own, *super().doubts]

    @property
    def scatter(self) -> tuple[tuple[str, ...], Float]:
        """Kinds of deviation of the exposures, and draws (n, k) of their scatter."""
        arrays = read_arrays(self.run / HIERARCHY, "", do=_AGAIN)
        return tuple(str(t, "utf-8") for t in arrays["kinds"]), arrays["tau_draws"]

    @property
    def settling(self) -> Settling:
        """What was done to the shifts of single chips."""
        return Settling.from_arrays(read_arrays(self.run / HIERARCHY, "", do=_AGAIN))

    def settled(self, posterior: Posterior) -> Posterior:
        """The draws with the chips where the exposures have them on average."""
        settling, (_, tau) = self.settling, self.scatter
        rng = self.rng("sample")
        some = tau[rng.integers(len(tau), size=len(posterior.flat))]
        theta = settling.draws(posterior.flat, some, rng).reshape(posterior.theta.shape)
        return replace(posterior, theta=theta)

    @cached_property
    def systematics(self) -> Systematics:
        """The posterior with the errors of the catalogue, and what a new exposure adds."""
        return systematics_of(self)

    @cached_property
    def terms(self) -> Series:
        """Linear terms of the exposures, each fitted by itself."""
        arrays = read_arrays(self.run / TERMS, "", do=_AGAIN)
        names, labels = ([str(t, "utf-8") for t in arrays[key]] for key in ("names", "labels"))
        return Series(
            arrays["epoch"],
            arrays["values"],
            arrays["cov"],
            tuple(labels),
            tuple(names),
            source="exposures",
        )

    def keep_terms(self, series: Series) -> None:
        """Write the linear terms for the stages that follow."""
        arrays = {"epoch": series.epoch, "values": series.values, "cov": series.cov}
        for key, texts in (("names", series.names), ("labels", series.coefficients)):
            arrays[key] = np.array([text.encode() for text in texts])
        write_arrays(self.run / TERMS, "", arrays)

    def rate_priors(self, model: DistortionModel) -> GaussianPriors | None:
        """Priors on the drift, where it is taken from the run of another filter."""
        return rate_priors(self._rates, model, chip=self.reference_chip, base=self.base)

    @property
    def free_rates(self) -> bool:
        """Whether the drift is that of this run's own exposures."""
        return self._rates == FREE

    @property
    def _rates(self) -> str:
        tdd = self.config.model.tdd
        return FREE if tdd is None else tdd.rates

    def fit_changed(self) -> None:
        """Forget what rests on the fit."""
        self.errors_changed()
        for name in ("fit", "model", "priors", "terms", "systematics", "discrepancy", "solution"):
            self.__dict__.pop(name, None)

    def forget(self) -> None:
        """Forget what rests on pairs, tables and errors."""
        self.fit_changed()
        for name in ("_all_matches", "_split", "_kept_tables", "raw_matches", "plain_model"):
            self.__dict__.pop(name, None)
