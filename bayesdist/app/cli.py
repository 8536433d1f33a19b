"""The command line."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from contextlib import closing

from bayesdist.app.screen import start_logging
from bayesdist.errors import BayesdistError

__all__ = ["main"]

MISSED = 4


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    arguments : sequence of str, optional
        In place of those of the process.

    Returns
    -------
    int
        0 good; 1 bad input; 2 usage; 3 not converged under --strict; 4 requirement missed; 130
        interrupted.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser().parse_args(arguments)
    options.line = shlex.join(["bayesdist", *arguments])
    start_logging(-1 if options.quiet else 0)
    try:
        return options.function(options) or 0
    except BayesdistError as error:
        sentence = " ".join(str(error).split())  # libraries below break their reasons into lines
        print(f"bayesdist: {sentence}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("bayesdist: interrupted; go on with --resume", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe had enough
        sys.stderr.close()
        return 0
    except OSError as error:  # the system refuses, and nobody below could say more
        where = f"{error.filename}: " if error.filename else ""
        print(f"bayesdist: {where}{error.strerror or error}.", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bayesdist",
        description="How well is the geometric distortion of a detector known?",
        epilog="Exit codes: 0 good, 1 bad input, 2 usage, 3 not converged under --strict, "
        "4 requirement missed.",
    )
    parser.add_argument("--version", action="version", version=f"bayesdist {_version()}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(name: str, function, text: str) -> argparse.ArgumentParser:  # type: ignore[no-untyped-def]
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.set_defaults(function=function)
        sub.add_argument("-q", "--quiet", action="store_true", help="only warnings and errors")
        return sub

    sub = add("demo", _demo, "the main job on simulated data, with the truth beside the estimate")
    sub.add_argument("-o", "--output", default="bayesdist-demo", metavar="DIR")
    sub.add_argument("--force", action="store_true", help="replace an earlier demo")

    sub = add("run", _run, "the whole job: fit, sample, assess, export, report")
    sub.add_argument("config", metavar="CONFIG.toml")
    sub.add_argument("-o", "--output", required=True, metavar="RUN")
    again = sub.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="go on with the run that is there")
    again.add_argument("--force", action="store_true", help="replace the run that is there")
    sub.add_argument("--strict", action="store_true", help="exit 3 unless converged")
    sub.add_argument("--seed", type=_seed, metavar="N", help="in place of the configured one")

    for stage, text in (
        ("match", "stage 0 of a campaign: star lists to pairs"),
        ("fit", "stage 1 of a run: the linear fit"),
        ("sample", "stage 2 of a run: the posterior, going on from its checkpoints"),
        ("assess", "stage 3 of a run: maps, budget, margins"),
        ("export", "stage 4 of a run: files for pipelines"),
        ("report", "stage 5 of a run: figures and report.html"),
    ):
        sub = add(stage, _stage, text)
        sub.set_defaults(stage=stage)
        sub.add_argument("run", metavar="RUN")
        if stage == "sample":
            sub.add_argument("--strict", action="store_true", help="exit 3 unless converged")

    sub = add("release", _release, "one set of files from the finished runs of several filters")
    sub.add_argument("runs", nargs="+", metavar="RUN", help="the reference filter's first")
    sub.add_argument("-o", "--output", required=True, metavar="DIR", help="a new folder")
    sub.add_argument("--force", action="store_true", help="also runs that have not converged")

    sub = add("check", _check, "units, rank, null space and expected cost; samples nothing")
    sub.add_argument("config", metavar="CONFIG.toml")

    sub = add("validate", _validate, "margins of a run against requirements; exit 4 unless all met")
    sub.add_argument("run", metavar="RUN")
    sub.add_argument("--requirements", required=True, metavar="REQ.toml")

    sub = add("inspect", _inspect, "what a product or a posterior holds, and what is wrong in it")
    sub.add_argument("file", metavar="FILE")

    sub = add("simulate", _simulate_wise, "data of known truth")
    kinds = sub.add_subparsers(title="what to simulate", required=True, metavar="WHAT")

    def kind(name: str, function, text: str) -> argparse.ArgumentParser:  # type: ignore[no-untyped-def]
        sub = kinds.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.set_defaults(function=function)
        sub.add_argument("-q", "--quiet", action="store_true", default=argparse.SUPPRESS)
        sub.add_argument("-o", "--output", required=True, metavar="DIR")
        sub.add_argument("--seed", type=_seed, default=1, metavar="N")
        sub.add_argument("--force", action="store_true", help="replace files that are there")
        return sub

    sub = kind("wise", _simulate_wise, "matched stars of WISE and 2MASS, with a configuration")
    bands = ["W1", "W2", "W3", "W4"]
    sub.add_argument("--bands", nargs="+", default=bands, metavar="W1", help="all by default")
    sub.add_argument("--pairs", type=int, metavar="N", help="of each band; as published by default")
    sub.add_argument("--false-share", type=float, default=0.03, metavar="F")
    sub.add_argument("--partition-pattern", action="store_true", help="blocks in the residuals")
    sub.add_argument("--stars", type=int, metavar="N", help="one small table of one band instead")
    sub.add_argument("--band", metavar="W2", help="of the small table")
    sub.add_argument("--fraction", type=float, help="of false matches in the small table")

    sub = kind("acs", _simulate_acs, "star lists, catalogue and log of the 47 Tuc campaign")
    sub.add_argument("--exposures", type=int, default=110, metavar="N", help="in F606W")
    sub.add_argument("--stars", type=int, default=53_900, metavar="N", help="of the catalogue")
    sub.add_argument("--filters", default="F606W", metavar="F606W,F814W", help="one or several")
    sub.add_argument("--other", type=int, default=15, metavar="N", help="exposures of each other")
    sub.add_argument("--false", type=float, default=0.05, help="share of detections that are none")
    sub.add_argument("--outlying", type=float, default=0.0, help="share of outlying exposures")
    sub.add_argument("--cte", action="store_true", help="trailed charge moves the stars")
    sub.add_argument("--smooth", action="store_true", help="without look-up tables")

    sub = add("init", _init, "a commented configuration for a file of matches")
    sub.add_argument("config", metavar="CONFIG.toml")
    sub.add_argument("--matches", required=True, metavar="FILE")
    sub.add_argument("--force", action="store_true", help="replace the file that is there")
    return parser


def _version() -> str:
    from bayesdist import __version__

    return __version__


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("a seed is 0 or more")
    return value


# Each command imports what it needs: the sampler and the figures take seconds to load.


def _demo(options: argparse.Namespace) -> None:
    from bayesdist.app.demo import demo

    print(demo(options.output, force=options.force, command=options.line))


def _run(options: argparse.Namespace) -> None:
    from bayesdist.app.demo import results_text
    from bayesdist.app.run import run
    from bayesdist.app.rundir import RunDirectory
    from bayesdist.app.session import Session

    path = run(
        options.config,
        options.output,
        resume=options.resume,
        force=options.force,
        strict=options.strict,
        seed=options.seed,
        command=options.line,
    )
    print(results_text(Session(RunDirectory(path))))  # its input was checked when it began


def _stage(options: argparse.Namespace) -> None:
    from bayesdist.app.run import continue_stage

    continue_stage(options.run, options.stage, strict=getattr(options, "strict", False))


def _release(options: argparse.Namespace) -> None:
    from bayesdist.app.release import release_runs

    print(release_runs(options.runs, options.output, force=options.force, command=options.line))


def _check(options: argparse.Namespace) -> None:
    from bayesdist.app.check import check

    print(check(options.config))


def _validate(options: argparse.Namespace) -> int:
    from bayesdist.app.campaign.session import session_of
    from bayesdist.app.config import load_requirements
    from bayesdist.app.demo import margins_text
    from bayesdist.app.rundir import RunDirectory
    from bayesdist.app.stages import require
    from bayesdist.app.stages.assess import margin_rows, margins_of, write_margins

    requirements = load_requirements(options.requirements)
    with closing(session_of(RunDirectory.open(options.run))) as session:
        require(session, "validate", ("fit", "sample"))
        margins = margins_of(session, requirements)
        write_margins(session, margins)
        label = session.posterior.approximation
    print(margins_text(margin_rows(margins)))
    for m in margins:
        if m.verdict != "met":
            print(f"{m.requirement.name}: {m.verdict}: {m.reason}")
    if label:
        print(f"WARNING: {label}")
    return 0 if all(m.verdict == "met" for m in margins) else MISSED


def _inspect(options: argparse.Namespace) -> None:
    from bayesdist.app.inspect import inspect

    print(inspect(options.file))


def _simulate_acs(options: argparse.Namespace) -> None:
    from bayesdist.app.simulate import simulate_campaign

    print(simulate_campaign(options))


def _simulate_wise(options: argparse.Namespace) -> None:
    from bayesdist.app.simulate_wise import simulate_wise_pairs

    print(simulate_wise_pairs(options))


def _init(options: argparse.Namespace) -> None:
    from bayesdist.app.init import init

    table = init(options.config, options.matches, force=options.force)
    print(f"{options.config}: for {len(table)} matches; read it, then 'bayesdist check' it")


if __name__ == "__main__":
    sys.exit(main())
