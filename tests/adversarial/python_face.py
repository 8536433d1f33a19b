"""Truths carried through the functions of the Python interface, one by one."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import chdir
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

import bayesdist as bd
from bayesdist.assess import Catalogue
from bayesdist.assess.domain import field_statistic
from bayesdist.assess.terms.given import said_by_user
from bayesdist.diagnose.diagnostics import Diagnostics, diagnose
from bayesdist.model.grid import grid_pixels, mesh

from .fields import SIDE
from .measure import DRAWS, GRID, without_motion
from .truth import Truth


@dataclass(frozen=True)
class Steps:
    """What the single functions made of one truth."""

    truth: Truth
    seed: int
    matches: bd.Matches
    fit: bd.LinearFit
    posterior: bd.Posterior
    diagnostics: Diagnostics
    # of budget and verdicts: terms and where errors are assessed
    options: dict[str, Any] = field(default_factory=dict)

    def margins(self, requirements: Sequence[bd.Requirement], **options: Any) -> tuple[Any, ...]:
        given = {"diagnostics": self.diagnostics, "rng": self.seed} | self.options | options
        return bd.check_requirements(self.posterior, requirements, **given)

    def budget(self, **options: Any) -> bd.ErrorBudget:
        given = {"diagnostics": self.diagnostics, "rng": self.seed} | self.options | options
        return bd.error_budget(self.posterior, **given)

    def actual_error(self) -> np.ndarray:
        """Predicted less true positions (ny * nx, 2), the best shift and rotation taken off."""
        model, mean = self.posterior.model, np.asarray(self.posterior.mean)
        x, y = mesh(*grid_pixels(model.chips[0].size, GRID))
        epoch = self.truth.epoch
        when = {"epoch": None if epoch is None else np.full(x.size, epoch)}
        true = self.truth.true_map(x, y, epoch)
        if model.frames == "none":
            error = np.asarray(model.predict(mean, x, y, **when)) - true
        else:
            code = int(np.random.default_rng([7, self.seed]).integers(1, len(model.exposures)))
            seen = model.predict(mean, x, y, exposure=np.full(x.size, code), **when)
            error = self.truth.frames[model.exposures[code]].undone(np.asarray(seen)) - true
        return without_motion(error, true)

    def true_p95(self) -> float:
        return float(field_statistic("p95", self.actual_error()))


def carried(truth: Truth, folder: Path, seed: int) -> Steps:
    """Stars of a truth fitted, sampled and diagnosed by the functions of the Python interface."""
    config, path = truth.config, folder / "stars.parquet"
    Table(truth.stars).write(path, overwrite=True)
    with chdir(folder):  # a run names its files relative to its configuration
        matches = bd.read_matches(path.name, unit="pix")
    drift = config["model"].get("tdd")
    model = bd.build_model(
        matches,
        order=config["model"]["order"],
        size=(float(SIDE), float(SIDE)),
        name="A",
        frames=config["model"].get("frames", "none"),
        time=None
        if drift is None
        else bd.TimeDependence(tuple(map(tuple, drift["terms"])), (drift["epoch0"],)),
    )
    fit = bd.fit_linear(matches, model)
    outliers = bd.OutlierMixture(**config.get("outliers", {}))
    posterior = bd.sample(fit, matches, outliers=outliers, seed=seed)
    options: dict[str, Any] = {"grid": GRID, "n_draws": DRAWS, "epoch": truth.epoch}
    options["exposure"] = config.get("assess", {}).get("exposure", "mean")
    rows = config.get("budget", [])
    if rows:
        row, *others = rows
        sizes = row["sigma_u"], row["sigma_v"]
        options["catalogue"] = Catalogue(row["name"], sizes, row["unit"], row.get("source", ""))
        options["terms"] = [
            bd.UserTerm(**other | {"source": said_by_user(other.get("source", ""))})
            for other in others
        ]
    return Steps(
        truth, seed, matches, fit, posterior, diagnose(posterior, matches, rng=seed), options
    )
