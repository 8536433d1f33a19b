"""`bayesdist check`: the effect of a configuration, without sampling."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from bayesdist.app.config import load_config
from bayesdist.app.evaluating import idle_dates
from bayesdist.app.kind import naming_displaced_stars
from bayesdist.app.pipeline import rehearse
from bayesdist.app.plausibility import doubts_on_run, left_out
from bayesdist.app.run import Run
from bayesdist.app.screen import number
from bayesdist.app.stars import in_circle
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.infer import Limits
from bayesdist.infer.sampler.sample import predict_sampling
from bayesdist.infer.sampler.schedule import expected_passes
from bayesdist.infer.solution.geometry import geometries
from bayesdist.utils.checks import warnings_of

# measured on two cores of a server at orders 4 and 5; other machines differ by factors
STAR_S = 3e-9  # seconds per star and pass of the likelihood
EXPANSION_S = 1.5e-8  # seconds per star of an expansion to second order
IN_CIRCLE = 80.0  # factor for stars matched within a circle about nominal positions
EXPANSIONS = 40  # number of expansions in the search for the proposal
OVERHEAD_S = 6e-5  # seconds per walker and step in emcee and the proposal
FIXED_S = 1.0  # seconds for diagnostics and files
MEMORY_MB = 256.0  # memory for stars; enough for the few passes of a check
# largest numbers of stars and parameters for a pilot run, which takes about ten seconds
MOST_STARS, MOST_PARAMS = 200_000, 200


def check(path: str | Path) -> str:
    """Units, rank, null space and expected cost of a configuration, as text.

    Raises InputError if a run would be refused: for bad input, or parameters that the data do not
    determine.
    """
    config, text = load_config(path)
    config = config.holding_at_most(MEMORY_MB)
    with TemporaryDirectory() as nowhere:
        directory = RunDirectory.plan(nowhere, config, text, Path(path).resolve().parent)
    with Run.of(directory) as run:
        rehearsed = rehearse(run)
        lines = run.kind.lines(rehearsed.inputs) or _lines(rehearsed)
        return "\n".join(lines)


def _lines(run: Run) -> Iterator[str]:
    """Lines of text on the fit of matched stars."""
    matches, model, fit, config = run.placed, run.model, run.fit, run.config
    sigma = run.shards.survey.reference_sigma
    yield (
        f"matches      {len(matches)} of {matches.n_rows} rows, "
        f"{len(matches.exposure_names)} exposure(s), u and v in {matches.unit}"
    )
    checks = run.checks
    stated = {check.sentence for check in checks}
    for note in matches.notes:
        if note not in stated:  # otherwise logged as a warning when its file was read
            yield f"read         {note}"
    for text in left_out(matches):
        yield f"left out     {text}"
    yield (
        f"errors       median {number(sigma)} {matches.unit}"
        + (" (by magnitude)" if run.errors.by_magnitude is not None else "")
    )
    if run.added_errors is not None:
        yield f"jitter       {run.added_errors.sentence(fit.unit)}"
    yield f"model        order {model.order}, frames '{model.frames}', {model.n_params} parameters"
    if len(model.chips) > 1:
        counts = zip(model.chips, run.shards.survey.chips, strict=True)
        yield "chips        " + ", ".join(f"{c.name} {s.n} stars" for c, s in counts)
    yield f"rank         {model.n_params} of {model.n_params}, nothing is degenerate"
    yield f"condition    {number(fit.condition)} (normal matrix, unit diagonal)"
    yield (
        f"linear fit   rms {number(fit.rms_u)}, {number(fit.rms_v)} {fit.unit}; "
        f"chi2/dof {number(fit.chi2 / max(fit.dof, 1))}; {fit.n_rejected} rows rejected"
    )
    chips = geometries(fit)
    for chip in chips:
        yield f"geometry     chip {chip.chip}: {chip.sentence}"
        if matches.tangent_point is not None and chip.mirrored:
            yield f"geometry     {chip.mirrored}"
    yield _cost(run)
    idle = idle_dates(config, config.requirements())
    for text in (
        *(text for text in doubts_on_run(run) if text not in stated),
        *(text for chip in chips for text in chip.warnings),
        *warnings_of(check for check in checks if check.sentence not in matches.notes),
        *([idle] if idle else []),
    ):
        yield f"WARNING      {text}"


def _cost(run: Run) -> str:
    """Line on the expected passes and seconds, or on why they cannot be predicted."""
    config, n = run.config, len(run.shards)
    sampler = config.sampler
    limits = Limits(sampler.target_ess, sampler.target_rhat)
    mixture = config.mixture(run.stars.match_radius)
    n_params = run.model.n_params + len(mixture.hyper)
    dear = IN_CIRCLE if in_circle(run.stars, config) else 1.0
    per_pass = dear * STAR_S * n
    over = f"over {n} stars, {number(1e3 * per_pass, 2)} ms each"
    search = dear * EXPANSIONS * EXPANSION_S * n + FIXED_S
    passes, provided = expected_passes(n_params, n, limits, sampler.ensembles), ""
    if dear * n > MOST_STARS or n_params > MOST_PARAMS:
        provided = " if the posterior is close to normal, which was not examined"
    else:
        with naming_displaced_stars(run):
            trial = predict_sampling(
                run.fit,
                run.shards,
                outliers=mixture,
                priors=run.priors,
                seed=sampler.seed,
                ensembles=sampler.ensembles,
                walkers=sampler.walkers,
                limits=limits,
                max_steps=sampler.max_steps,
            )
        if trial.passes is None:
            longest = number(search + trial.most_passes * (per_pass + OVERHEAD_S), 2)
            return (
                f"cost         cannot be known before sampling {over}: the posterior is far from "
                f"normal (importance efficiency {number(trial.quality.efficiency, 2)}, Pareto k "
                f"{number(trial.quality.k, 2)}); sampler.max_steps ends it after "
                f"{trial.most_passes} passes, about {longest} s"
            )
        passes = trial.passes
    total = search + passes * (per_pass + OVERHEAD_S)
    return (
        f"cost         about {passes} passes {over}: "
        f"{number(total, 2)} s to the posterior{provided}"
    )
