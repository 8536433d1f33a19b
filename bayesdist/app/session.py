"""What the stages of one run share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.config import Config
from bayesdist.app.rundir import RunDirectory
from bayesdist.assess import Misfit, misfit_of
from bayesdist.data import MagnitudeErrors, MatchTable, atomic_path, read_matches
from bayesdist.infer import (
    GaussianPriors,
    LinearFit,
    Posterior,
    build_model,
    fit_by_magnitude,
    fit_linear,
    load_fit,
    load_posterior,
)
from bayesdist.model import DistortionModel

__all__ = ["ERROR_COLUMNS", "STAGES", "Session", "write_table"]

STAGES = ("fit", "sample", "assess", "export", "report")

ERROR_COLUMNS = ("mag", "sigma_u", "sigma_v", "n", "scatter_u", "scatter_v")


@dataclass
class Session:
    """What the stages of one run share; everything is read when it is first needed.

    Parameters
    ----------
    run : RunDirectory
    progress : callable, optional
        Called with (steps made, most steps) while sampling.
    """

    run: RunDirectory
    progress: Callable[[int, int], None] | None = None

    @cached_property
    def config(self) -> Config:
        """The resolved configuration."""
        return self.run.config

    @cached_property
    def raw_matches(self) -> MatchTable:
        """Matches as read."""
        data = self.config.data
        return read_matches(
            self.run.matches,
            format=data.format,
            columns=data.columns,
            unit=data.unit,
            sigma=data.sigma,
            pixel_origin=data.pixel_origin,
            tangent_point=data.tangent_point,
        )

    @cached_property
    def magnitude_errors(self) -> MagnitudeErrors | None:
        """Errors by magnitude, as the fit left them."""
        path = self.run / "magnitude_errors.ecsv"
        if self.config.data.sigma != "by_magnitude" or not path.exists():
            return None
        table = Table.read(path)
        return MagnitudeErrors(**{name: np.asarray(table[name]) for name in ERROR_COLUMNS})

    @cached_property
    def matches(self) -> MatchTable:
        """Matches with their errors."""
        errors = self.magnitude_errors
        if errors is None:
            return self.raw_matches
        return self.raw_matches.with_sigma(*errors.at(self.raw_matches.mag))

    @cached_property
    def model(self) -> DistortionModel:
        """The model that the configuration asks for."""
        config = self.config
        return build_model(
            self.raw_matches,
            order=config.model.order,
            size=config.detector.size,
            reference_pixel=config.model.reference_pixel,
            name=config.detector.name,
            chips=config.chips(),
            frames=config.model.frames,
            time=config.time(),
        )

    @cached_property
    def priors(self) -> GaussianPriors:
        """Priors of the model's parameters."""
        named = {p.parameter: (p.mean, p.sigma) for p in self.config.prior}
        return GaussianPriors.of(self.model, named)

    @cached_property
    def linear(self) -> tuple[LinearFit, MagnitudeErrors | None]:
        """The linear fit that the configuration asks for, made now; nothing is written."""
        fit = self.config.fit
        options: dict[str, Any] = {
            "clip_chi2": fit.clip_chi2,
            "clip_abs": fit.clip_abs,
            "radial_weight": fit.radial_weight,
            "priors": self.priors,
        }
        if self.config.data.sigma == "by_magnitude":
            solution, _, errors = fit_by_magnitude(self.raw_matches, self.model, **options)
            return solution, errors
        return fit_linear(self.raw_matches, self.model, **options), None

    @cached_property
    def fit(self) -> LinearFit:
        """The linear fit of an earlier stage."""
        return load_fit(self.run / "fit.nc")

    @cached_property
    def posterior(self) -> Posterior:
        """The posterior of an earlier stage."""
        return load_posterior(self.run / "posterior.nc")

    @property
    def scale_arcsec(self) -> float | None:
        """Size of a pixel in arcsec, where the configuration gives it."""
        scale = self.config.detector.scale_mas
        return None if scale is None else scale / 1000

    @property
    def fitted(self) -> np.ndarray:
        """Which stars of the first chip the least-squares fit used."""
        fit, matches = self.fit, self.matches
        if len(fit.model.chips) == 1:
            return fit.used
        numbers = np.asarray(matches.chip_numbers)[matches.chip]
        return fit.used & (numbers == fit.model.chips[0].number)

    @cached_property
    def misfit(self) -> Misfit:
        """Structure that the least-squares fit leaves in the residuals of the first chip."""
        fit, matches, good = self.fit, self.matches, self.fitted
        return misfit_of(
            matches.x[good],
            matches.y[good],
            fit.residual[good],
            size=fit.model.chips[0].size,
            n_params=2 * fit.model.n_terms,
            unit=fit.unit,
        )

    def rng(self, stage: str) -> np.random.Generator:
        """Random numbers of a stage: all follow from the one seed."""
        return np.random.default_rng([self.config.sampler.seed, STAGES.index(stage)])

    @property
    def epoch(self) -> float | None:
        """Epoch of the assessment; the middle of the data where none is given."""
        if self.config.assess.epoch is not None or self.model.time is None:
            return self.config.assess.epoch
        assert self.raw_matches.epoch is not None
        return float(np.median(self.raw_matches.epoch))


def write_table(table: Table, path: Path) -> None:
    with atomic_path(path) as temporary:
        table.write(temporary, format="ascii.ecsv")
