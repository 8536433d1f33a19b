"""`bayesdist monitor`: test whether the released solution of a run still describes new matches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.app.commands.compare import joined
from bayesdist.app.config import Config, load_config
from bayesdist.app.kind import RunKind
from bayesdist.app.run import Run
from bayesdist.app.store.record import attributes, record_folder, write_table
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.assess.comparison.change_maps import Monitored, change_maps, is_late
from bayesdist.assess.comparison.compare import comparison_table, difference_table
from bayesdist.assess.units import convert, pixel_scale_of
from bayesdist.data import Matches, input_files
from bayesdist.diagnose.residuals.misfit import misfits_of, residual_sums, worst_misfit
from bayesdist.errors import InputError
from bayesdist.files.atomic import sha256_of
from bayesdist.infer import Posterior
from bayesdist.infer.compare.change_date import PeriodScore, period_scores, scan_dates
from bayesdist.infer.compare.monitoring import NewFit, change_of, fit_new
from bayesdist.infer.posterior.memberships import count_outliers
from bayesdist.infer.solution.linear import Rejection
from bayesdist.plugin import load_object
from bayesdist.report.drawing import save_figures
from bayesdist.report.figures.commands import change_over_time, difference_vectors

CHANGE_MAPS = 1  # number of the random stream of the maps, derived from the seed


def monitor(
    run: str | Path, new: str | Path, output: str | Path | None = None, *, command: str = ""
) -> str:
    """Test new matches against the posterior of a run; files are written to a new folder `output`.

    The matches that the run was made from are no longer needed.

    Parameters
    ----------
    run : path
        Released run.
    new : path
        New matches, which are read like those of the run; or a configuration, a run or a folder
        with a config.toml that has a section [data].  Files that the release was made from are left
        out.  For a campaign: another run with completed stage 'match', or pairs as stored in a run.
        For a self-calibration: a configuration with [data]; the linear part of each exposure is
        free.
    output : path, optional
        Folder to create.
    command : str
        Command line, for the record.

    Returns
    -------
    str
        Verdict and further lines.
    """
    directory = RunDirectory(run)
    if not directory.is_initialized:
        raise directory.not_a_run_error()
    directory.require("monitor", ("fit", "sample", "diagnose"))
    config = directory.config
    posterior, matches, fitted, left_out = _fitted(directory, config, Path(new))
    try:
        shards = fitted.target.shards
        change = change_of(fitted, draws=posterior.convergence.ess_bulk_min)
        scores: tuple[PeriodScore, ...] = ()
        if matches.has_epoch:
            scores = period_scores(fitted, change, matches)
        date = scan_dates(scores, change) if scores else None
        late = date is not None and is_late(change, date)
        nx, ny = config.assess.grid
        result = Monitored(
            change=change,
            maps=change_maps(
                date.change if late and date is not None else change,
                rng=np.random.default_rng([config.sampler.seed, CHANGE_MAPS]),
                names=(str(new), str(run)),
                grid=(nx, ny),
            ),
            date=date,
            misfit=worst_misfit(
                misfits_of(fitted.fit, *residual_sums(fitted.fit, shards, fitted.likelihood))
            ),
            pixel_mas=pixel_scale_of(posterior, scale_mas=config.detector.scale_mas),
        )
        facts = _facts(fitted, posterior) | _planes(posterior, matches)
        facts |= {"left_out": list(left_out), "rejected": dict(matches.rejected)}
    finally:
        fitted.target.shards.close()
    if output is not None:
        _write(Path(output), result, scores, facts, command)
    return "\n".join([result.verdict, *_lines(result, facts, scores)])


def _fitted(
    run: RunDirectory, config: Config, new: Path
) -> tuple[Posterior, Matches, NewFit, tuple[str, ...]]:
    """Release, new matches and their fit, and exposures or files that the release has used."""
    release = Run.of(run)
    posterior, fitted = release.solution, release.kind.fit_of_new_exposures(release, new)
    if fitted is not None:
        return posterior, *fitted
    matches, used_files = _new_matches(release, new)
    new_fit = fit_new(
        posterior,
        matches,
        rejection=Rejection(config.fit.clip_chi2, config.fit.clip_abs),
        compute=config.resources(),
        frames=release.kind.new_frames,
    )
    return posterior, matches, new_fit, used_files


def _new_matches(release: Run, new: Path) -> tuple[Matches, tuple[str, ...]]:
    """New matches with errors, read like those of the run or as a configuration of theirs states.

    The second value names files that are left out because the release was made from them.
    """
    if not new.exists():
        raise InputError("there is no such file", where=str(new), do="check the name")
    configured = _configuration_of(release.directory, new)
    path: Path | list[Path]
    if configured is not None:
        config, base = configured
        kind: RunKind[Any, Any] = load_object(config.kind)
        if not kind.reads_matches:  # its exposures would have to be matched first
            raise InputError(
                "names no table of matches", where=str(new), do="give one in data.matches"
            )
        path = config.named_files(base)
    else:
        config, kind, path = release.config, release.kind, new
        if not kind.reads_matches:
            raise InputError(
                "is a table, but this kind of run has no section [data] that states how to read it",
                where=str(new),
                do="give a configuration whose [data] names it",
            )
    used_files = _files_of_release(release.directory, path)
    if used_files and not Path(new).is_dir():
        path = [file for file in input_files(path) if file not in used_files]
    matches = kind.read_new_matches(config, path, release, dated=configured is not None)
    from_release = [k for k, name in enumerate(matches.sources) if Path(name) in used_files]
    if from_release:  # parts of one table that are read together
        matches = matches.load()
        matches = matches.select(~np.isin(matches.source, from_release))
    return matches, tuple(str(file) for file in used_files)


def _configuration_of(run: RunDirectory, new: Path) -> tuple[Config, Path] | None:
    """Configuration for reading new matches, and the folder that its names are relative to.

    `new` is a configuration, a run, or a folder with a config.toml; None for anything else.
    """
    if new.suffix == ".toml":
        return load_config(new)[0], new.parent
    if (new / "run.json").exists():
        if new.resolve() == run.path.resolve():
            raise InputError(
                "is the released run itself",
                where=str(new),
                do="give a file of new matches, or a configuration whose [data] names it",
            )
        new_run = RunDirectory(new)
        return new_run.config, new_run.base
    if (new / "config.toml").exists():
        return load_config(new / "config.toml")[0], new
    return None


def _files_of_release(run: RunDirectory, path: Path | list[Path]) -> list[Path]:
    """Files of `path` that the release was made from, identified by content.

    They cannot test the release.  Raises InputError if there are no other files.
    """
    hashes = set(run.facts["inputs"].values())
    files = input_files(path)
    used_files = [file for file in files if sha256_of(file) in hashes]
    if len(used_files) == len(files):
        raise InputError(
            "the release was made from these matches, so they cannot test it",
            where=str(used_files[0]),
            do="give matches that were not part of its fit",
        )
    return used_files


def _facts(new: NewFit, posterior: Posterior) -> dict[str, Any]:
    """Facts about the new matches other than the change."""
    n = new.target.n_theta
    shards = new.target.shards
    flagged, _ = count_outliers(shards, new.target.hyper, new.theta[None], new.psi[None, n:])
    released = {k: (float(v.mean()), float(v.std(ddof=1))) for k, v in posterior.hyper.items()}
    return {
        "n_matches": len(shards),
        "n_flagged": flagged,
        "n_exposures": len(new.model.exposures),
        "frames": new.open.frames,
        "deviating": bool(new.scatter.any()),
        "unit": new.model.unit,
        "mixture": new.hyper,
        "mixture_released": {k: {"mean": m, "sd": s} for k, (m, s) in released.items()},
        "converged": bool(posterior.convergence.converged),
    }


def _planes(posterior: Posterior, matches: Matches) -> dict[str, Any]:
    """Tangent points of the new matches and of the release, RA and Dec in degrees, or None."""
    points = {
        "tangent_point": matches.tangent_point,
        "tangent_point_released": posterior.tangent_point,
    }
    return {name: None if point is None else list(point) for name, point in points.items()}


def _lines(found: Monitored, facts: dict[str, Any], scores: Sequence[PeriodScore]) -> list[str]:
    """Lines of text below the verdict."""
    frames = "nothing" if facts["frames"] == "none" else facts["frames"].replace("_", ", ")
    lines = [
        f"new matches: {facts['n_matches']}, of which {facts['n_flagged']} are more likely false "
        f"than not, in {facts['n_exposures']} exposure(s); fitted to each and taken out: {frames}"
    ]
    if facts["deviating"]:
        lines.append("exposures deviate as those of the release scatter")
    point, released = facts["tangent_point"], facts["tangent_point_released"]
    if point is not None and released is not None and point != released:
        lines.append(
            f"the tangent point of the new matches is {point}, that of the release {released}"
        )
    elif (point is None) != (released is None):
        side = "the new matches" if point is None else "the release"
        lines.append(
            f"u and v of {side} state no tangent point and are taken to have that of the other "
            f"side, {point or released}"
        )
    if facts["left_out"]:
        names = facts["left_out"]
        ellipsis = "" if len(names) < 4 else ", ..."
        lines.append(
            f"left out: {len(names)} exposure(s) or file(s) that the release was made from "
            f"({', '.join(names[:3])}{ellipsis})"
        )
    lines += [f"rows left out: {n} ({reason})" for reason, n in facts["rejected"].items()]
    for key, title in (
        ("j", "error beyond the quoted ones"),
        ("f", "fraction of false matches"),
    ):
        if key in facts["mixture"] and key in facts["mixture_released"]:
            old = facts["mixture_released"][key]
            unit = f" {facts['unit']}" if key == "j" else ""
            lines.append(
                f"{title}: {facts['mixture'][key]:.3g}{unit}; of the release {old['mean']:.3g} +- "
                f"{old['sd']:.2g}"
            )
    if found.change.epoch is not None:
        lines.append(
            f"compared at {found.change.epoch:.3f}, the errors of the extrapolated drift included"
        )
    if found.date is not None and len(scores) > 1:
        lines.append(
            f"mean change p = {found.p_value:.2g}; a change at one of {len(scores)} dates "
            f"p = {found.p_since:.2g}; scatter of the periods {found.date.scatter:.3g} of what "
            f"errors make (p = {found.date.p_scatter:.2g})"
        )
    lines += [f"WARNING: {doubt}" for doubt in found.doubts]
    if not facts["converged"]:
        lines.append("WARNING: the released posterior has not converged")
    return lines


def _write(
    output: Path,
    found: Monitored,
    scores: Sequence[PeriodScore],
    facts: dict[str, Any],
    command: str,
) -> None:
    date, maps = found.date, found.maps
    with record_folder(output, "monitor.json", command) as (folder, record):
        write_table(joined(maps, comparison_table), folder / "change.ecsv")
        write_table(joined(maps, difference_table), folder / "difference.ecsv")
        figures = {"change": difference_vectors(maps, names=("new", "release"))}
        if date is not None:
            table = Table(
                {
                    "first": [s.first for s in scores],
                    "last": [s.last for s in scores],
                    "n": [s.n for s in scores],
                    "gain": date.gain,
                }
            )
            write_table(table, folder / "dates.ecsv")
            if len(scores) > 1:
                figures["dates"] = change_over_time(
                    table["first"], date.gain, date.dof, found.p_since
                )
        save_figures(figures, folder / "figures")
        record |= _summary(found, facts)


def _summary(found: Monitored, facts: dict[str, Any]) -> dict[str, Any]:
    test, date, worst = found.change.test, found.date, found.worst
    since = None
    if date is not None:
        since = attributes(date, "after before scatter scatter_dof p_scatter")
        since |= {"interval_95": date.interval, "p_value": found.p_since}
    scale = found.pixel_mas
    return {
        "verdict": found.verdict,
        "changed": found.changed,
        "p_value": found.p_either,
        "mean_change": {"chi2": test.chi2, "dof": test.dof, "p_value": found.p_value},
        "epoch": found.change.epoch,
        "size": {
            "unit": "pix",
            **attributes(worst, "rms noise_rms"),
            "max": worst.largest,
            "sigma_of_max": worst.sigma_of_largest,
            "position_of_max": list(worst.position_of_largest),
            "chip": worst.a.chip,
            "of": "change from its date on" if found.since_a_date else "mean change",
            "max_mas": None if scale is None else convert(worst.largest, "pix", "mas", scale),
        },
        "since": since,
        "warnings": found.doubts,
        "new": facts,
    }
