"""`bayesdist check`: what a configuration would do, without sampling."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from bayesdist.app.config import load_config
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.screen import number
from bayesdist.app.session import Session
from bayesdist.app.stages import rehearse
from bayesdist.app.stages.assess import warnings_of
from bayesdist.infer import GaussianPriors, OutlierMixture
from bayesdist.infer.sampler import FIRST_CHECK
from bayesdist.infer.stars import prepare
from bayesdist.infer.target import Target

__all__ = ["check"]

WALKERS = 64  # of all ensembles, where the proposal is good
PASSES = 2 * FIRST_CHECK * WALKERS
EXPANSIONS = 75  # second-order expansions of the search for the proposal: 25 nodes of about 3 steps
OVERHEAD_S = 6e-5  # of emcee and the proposal, for each walker and step
FIXED_S = 1.0  # diagnostics and files


def check(path: str | Path) -> str:
    """Units, rank, null space and expected cost of a configuration.

    Parameters
    ----------
    path : path
        Configuration file.

    Returns
    -------
    str
        A readable text.

    Raises
    ------
    BayesdistError
        For whatever would stop the run: bad input, or parameters that the data do not determine.
    """
    config, text = load_config(path)
    with TemporaryDirectory() as nowhere:
        run = RunDirectory.plan(nowhere, config, text, Path(path).resolve().parent)
    session = Session(run)
    rehearse(session)
    matches, model = session.raw_matches, session.model
    fit, errors = session.linear
    if errors is not None:
        matches = matches.with_sigma(*errors.at(matches.mag))
    target = Target(prepare(model, matches), OutlierMixture(), GaussianPriors.none(model))
    psi = np.concatenate([fit.mean, target.hyper.point({"j": 0.1, "f": 0.05, "s_out": 1.0})])
    target.log_density(psi[None])  # compiles, or loads what was compiled
    started = perf_counter()
    n = max(1, min(200, 2_000_000 // len(matches)))
    target.log_density(np.repeat(psi[None], n, axis=0))
    per_pass = (perf_counter() - started) / n
    started = perf_counter()
    target.expand(psi)
    search = EXPANSIONS * (perf_counter() - started)
    total = search + PASSES * (per_pass + OVERHEAD_S) + FIXED_S
    lines = [
        f"matches      {len(matches)} of {matches.n_rows} rows, "
        f"{len(matches.exposure_names)} exposure(s), u and v in {matches.unit}",
        f"errors       median {number(target.hyper.scale)} {matches.unit}"
        + (" (by magnitude)" if errors is not None else ""),
        f"model        order {model.order}, frames '{model.frames}', {model.n_params} parameters",
        f"rank         {model.n_params} of {model.n_params}, nothing is degenerate",
        f"condition    {number(fit.condition)} (normal matrix, unit diagonal)",
        f"linear fit   rms {number(fit.rms_u)}, {number(fit.rms_v)} {fit.unit}; "
        f"chi2/dof {number(fit.chi2 / max(fit.dof, 1))}; {int((~fit.used).sum())} rows rejected",
        f"cost         {number(1e3 * per_pass, 3)} ms a pass, about {PASSES} passes: "
        f"{number(total, 2)} s to the posterior if it is well behaved",
    ]
    session.fit, session.matches = fit, matches  # what a run would read from its files
    lines += [f"WARNING      {text}" for text in warnings_of(session)]
    return "\n".join(lines)
