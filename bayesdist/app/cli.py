"""The command line."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence

from bayesdist.app.screen import start_logging
from bayesdist.errors import BayesdistError, InputError

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

    sub = add("bands", _bands, "tables and diagrams of several bands beside each other")
    sub.add_argument("runs", nargs="+", metavar="RUN", help="finished runs, one for each band")
    sub.add_argument("-o", "--output", required=True, metavar="DIR", help="a new folder")
    sub.add_argument("--bins", type=int, default=31, metavar="N", help="of residuals, on each axis")
    text = "SIP header or WISE meta-data of an optical model; one, or one for each run"
    sub.add_argument("--optical", nargs="+", default=(), metavar="FILE", help=text)
    sub.add_argument("--turn", type=float, default=0.0, metavar="DEG", help="of the optical model")
    sub.add_argument("--no-published", action="store_true", help="without values of WISE's report")

    sub = add("check", _check, "units, rank, null space and expected cost; samples nothing")
    sub.add_argument("config", metavar="CONFIG.toml")

    sub = add("order", _order, "which polynomial order the data of a configuration ask for")
    sub.add_argument("config", metavar="CONFIG.toml")
    sub.add_argument("--orders", nargs=2, type=int, default=(3, 9), metavar=("LOW", "HIGH"))
    sub.add_argument("-o", "--output", metavar="orders.ecsv", help="the table as a file")
    sub.add_argument("--figure", metavar="orders.png")
    sub.add_argument("--force", action="store_true", help="replace files that are there")

    sub = add("validate", _validate, "margins of a run against requirements; exit 4 unless all met")
    sub.add_argument("run", metavar="RUN")
    sub.add_argument("--requirements", required=True, metavar="REQ.toml")

    sub = add("budget", _budget, "what the error of a position, or of a distance, is made of")
    sub.add_argument("run", metavar="RUN")
    place = {"nargs": 2, "type": float, "metavar": ("X", "Y")}
    sub.add_argument("--at", required=True, help="FITS 1-based pixel", **place)
    sub.add_argument(
        "--to", action="append", default=[], help="of the difference to this pixel", **place
    )
    sub.add_argument("--chip", type=int, metavar="N")
    sub.add_argument("--epoch", type=float, metavar="T", help="decimal years")
    sub.add_argument("--magnitude", type=float, metavar="M", help="adds the centroid's error")

    text = "how many more exposures would meet the requirements, or which dither pattern is best"
    sub = add("plan", _plan, text)
    text = "a run; or a file of dither patterns, to be compared without data"
    sub.add_argument("run", metavar="RUN | PATTERNS.toml", help=text)
    sub.add_argument("--requirement", metavar="NAME", help="one of them; all by default")
    sub.add_argument("--epochs", nargs="+", type=float, default=[], metavar="T", help="dates")
    text = "a new folder for the comparison of patterns"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)

    sub = add("inspect", _inspect, "what a product or a posterior holds, and what is wrong in it")
    sub.add_argument("file", metavar="FILE")

    def applied(name: str, function, text: str) -> argparse.ArgumentParser:  # type: ignore[no-untyped-def]
        sub = add(name, function, text)
        sub.add_argument("file", metavar="FILE", help="an IDCTAB, a run, or what `compare` takes")
        sub.add_argument("--filter", metavar="F", help="of an IDCTAB, or WISE band")
        sub.add_argument("--epoch", type=float, metavar="T", help="decimal years, for what drifts")
        sub.add_argument("--scale", type=float, metavar="S", help="of a corrected pixel")
        return sub

    pair = {"nargs": 2, "type": float}
    sub = applied("apply", _apply, "pixels to the undistorted frame, or back, with their errors")
    sub.add_argument("table", metavar="TABLE", help="columns x, y, chip; back: x_out, y_out")
    sub.add_argument("-o", "--output", required=True, metavar="OUT", help=".ecsv, .csv or .fits")
    sub.add_argument("--inverse", action="store_true", help="back to pixels")
    text = "of the inverse: by Newton, by a polynomial fitted here, by INVERSE rows"
    sub.add_argument(
        "--method", choices=("newton", "polynomial", "table"), default="newton", help=text
    )
    sub.add_argument("--order", type=int, metavar="N", help="of the polynomial fitted")
    sub.add_argument("--columns", nargs=2, metavar=("X", "Y"), help="names of the positions")
    sub.add_argument("--chip", type=int, metavar="N", help="in place of a column")
    text = "output pixel of the zero point; 0 0 by default"
    sub.add_argument("--origin", metavar=("X", "Y"), help=text, **pair)
    sub.add_argument("--vafactor", type=float, default=1.0, metavar="V", help="of the exposure")
    sub.add_argument("--image", metavar="FLT", help="a calibrated image whose pixels these are")
    sub.add_argument("--ltv", metavar=("LTV1", "LTV2"), help="of a subarray", **pair)
    sub.add_argument("--corner", metavar=("X", "Y"), help="first pixel of a subarray", **pair)
    sub.add_argument("--force", action="store_true", help="replace the file that is there")

    sub = applied("pam", _pam, "pixel area maps, with their errors")
    sub.add_argument("-o", "--output", required=True, metavar="OUT.fits")
    sub.add_argument("--chip", type=int, metavar="N", help="in the primary HDU; all by default")
    sub.add_argument("--image", metavar="FLT", help="a calibrated image that the maps are to fit")
    sub.add_argument("--force", action="store_true", help="replace the file that is there")

    text = "figures and numbers as in the ACS handbook, published ones beside"
    sub = applied("handbook", _handbook, text)
    sub.add_argument("-o", "--output", required=True, metavar="DIR", help="a new folder")
    sub.add_argument("--detector", metavar="WFC", help="of ACS, whose numbers stand beside")
    sub.add_argument("--magnification", type=float, metavar="M", help="of the vectors")

    sub = add("compare", _compare, "how two calibrations differ, and whether significantly")
    sub.add_argument("a", metavar="A", help="a run, posterior, fit, IDCTAB, SIP header, WISE file")
    sub.add_argument("b", metavar="B", help="the other one")
    sub.add_argument("-o", "--output", metavar="DIR", help="a new folder for tables and figure")
    sub.add_argument("--chip", type=int, metavar="N", help="all common chips by default")
    sub.add_argument("--filter", metavar="F", help="of IDCTABs, or WISE band; F:G for A and B")
    sub.add_argument("--epoch", type=float, metavar="T", help="decimal years, for what drifts")
    sub.add_argument("--keep-linear", action="store_true", help="leave shift, rotation, scale in")
    sub.add_argument("--grid", type=int, nargs=2, default=(33, 17), metavar=("NX", "NY"))

    sub = add("monitor", _monitor, "does a released solution still describe new matches?")
    sub.add_argument("run", metavar="RUN", help="the run whose posterior is released")
    sub.add_argument("new", metavar="NEW", help="matches, or a CONFIG.toml that names them")
    sub.add_argument("-o", "--output", metavar="DIR", help="a new folder for tables and figure")

    sub = add("rotate", _rotate, "a distortion in rotated or mirrored pixels")
    sub.add_argument("file", metavar="FILE", help="a SIP header, or WISE meta-data")
    sub.add_argument("--angle", type=float, default=0.0, metavar="DEG", help="from x towards y")
    sub.add_argument("--mirror", action="store_true", help="change the sign of x first")
    sub.add_argument("-o", "--output", required=True, metavar="OUT")
    sub.add_argument("--force", action="store_true", help="replace the file that is there")

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

    text = "transform the reference positions of WISE's RvB pairs"
    sub = commands.add_parser("rvb", help=text, description=text[0].upper() + text[1:] + ".")
    _add_rvb(sub.add_subparsers(title="what to do", required=True, metavar="WHAT"))

    sub = add("init", _init, "a commented configuration for a file of matches")
    sub.add_argument("config", metavar="CONFIG.toml")
    sub.add_argument("--matches", required=True, metavar="FILE")
    text = "columns that are not found by their names (KEY= leaves one out)"
    sub.add_argument("--columns", nargs="+", default=[], metavar="KEY=NAME", help=text)
    text = "columns and rows of each chip; by default guessed from the positions"
    sub.add_argument("--size", nargs=2, type=int, metavar=("NX", "NY"), help=text)
    sub.add_argument("--force", action="store_true", help="replace the file that is there")
    return parser


def _add_rvb(kinds) -> None:  # type: ignore[no-untyped-def]
    def kind(name: str, function, text: str) -> argparse.ArgumentParser:  # type: ignore[no-untyped-def]
        sub = kinds.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.set_defaults(function=function)
        sub.add_argument("files", nargs="+", metavar="FILE", help="IPAC table, Parquet, a folder")
        sub.add_argument("-o", "--output", required=True, metavar="DIR", help="a new folder")
        sub.add_argument("--band", metavar="W1", help="needed where the files hold several")
        sub.add_argument(
            "--column", action="append", default=[], metavar="KEY=NAME", help="as data.columns"
        )
        sub.add_argument("-q", "--quiet", action="store_true", help="only warnings and errors")
        return sub

    sub = kind("transform", _rvb_transform, "all pairs by one linear transformation")
    for option, what in (
        ("--dx", "shift of the reference positions along x, pixels"),
        ("--dy", "shift along y, pixels"),
        ("--rotation", "about the array's centre, degrees from x towards y"),
        ("--scale-x", "relative to one: 1e-4 stretches x by so much"),
        ("--scale-y", "relative to one"),
    ):
        sub.add_argument(option, type=float, default=0.0, metavar="A", help=what)

    sub = kind("rereference", _rvb_rereference, "each frame from one solution to another")
    for option, name, what in (
        ("--from", "free", "frame solutions that the pairs were made with"),
        ("--to", "fixed", "those that they are brought to"),
    ):
        sub.add_argument(option, dest=name, required=True, metavar="TABLE", help=what)


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
    from bayesdist.missions.wise.demo import demo

    print(demo(options.output, force=options.force, command=options.line))


def _run(options: argparse.Namespace) -> None:
    from bayesdist.app.run import run
    from bayesdist.app.rundir import RunDirectory
    from bayesdist.app.session import Session
    from bayesdist.app.summary_text import results_text

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


def _bands(options: argparse.Namespace) -> None:
    from bayesdist.missions.wise.bands.command import bands_of_runs

    text = bands_of_runs(
        options.runs,
        options.output,
        bins=options.bins,
        optical=options.optical,
        turn=options.turn,
        published=not options.no_published,
        command=options.line,
    )
    print(text)


def _check(options: argparse.Namespace) -> None:
    from bayesdist.app.check import check

    print(check(options.config))


def _order(options: argparse.Namespace) -> None:
    from bayesdist.app.order import order

    files = {"output": options.output, "figure": options.figure}
    print(order(options.config, options.orders, **files, force=options.force))


def _validate(options: argparse.Namespace) -> int:
    from bayesdist.app.validate import validate

    text, met = validate(options.run, options.requirements)
    print(text)
    return 0 if met else MISSED


def _budget(options: argparse.Namespace) -> None:
    from bayesdist.app.budget import budget_at

    print(
        budget_at(
            options.run,
            tuple(options.at),
            to=[tuple(pixel) for pixel in options.to],
            chip=options.chip,
            epoch=options.epoch,
            magnitude=options.magnitude,
        )
    )


def _plan(options: argparse.Namespace) -> None:
    from bayesdist.app.patterns.command import plan_patterns
    from bayesdist.app.plan import plan

    if options.run.endswith(".toml"):
        if options.requirement or options.epochs:
            raise InputError(
                "dither patterns are compared without requirements and dates",
                where=options.run,
                do="leave --requirement and --epochs out, or give a run",
            )
        print(plan_patterns(options.run, options.output, options.line))
        return
    if options.output:
        raise InputError(
            "the plan of a run writes no files",
            where=options.run,
            do="leave -o out, or give a file of dither patterns (PATTERNS.toml)",
        )
    print(plan(options.run, name=options.requirement, epochs=options.epochs))


def _inspect(options: argparse.Namespace) -> None:
    from bayesdist.app.inspect import inspect

    print(inspect(options.file))


def _apply(options: argparse.Namespace) -> None:
    from bayesdist.app.apply import apply_to_table

    names = "inverse method order columns chip filter epoch scale origin vafactor image ltv corner"
    chosen = {name: getattr(options, name) for name in (*names.split(), "force")}
    print(apply_to_table(options.file, options.table, options.output, **chosen))


def _pam(options: argparse.Namespace) -> None:
    from bayesdist.missions.acs.pam import write_area_maps

    names = ("chip", "filter", "epoch", "scale", "image", "force")
    chosen = {name: getattr(options, name) for name in names}
    print(write_area_maps(options.file, options.output, **chosen))


def _handbook(options: argparse.Namespace) -> None:
    from bayesdist.missions.acs.handbook import handbook

    names = ("filter", "epoch", "scale", "detector", "magnification")
    chosen = {name: getattr(options, name) for name in names}
    print(handbook(options.file, options.output, **chosen))


def _compare(options: argparse.Namespace) -> None:
    from bayesdist.app.compare import compare_files

    text = compare_files(
        options.a,
        options.b,
        options.output,
        chip=options.chip,
        filter=options.filter,
        epoch=options.epoch,
        keep=options.keep_linear,
        grid=options.grid,
        command=options.line,
    )
    print(text)


def _monitor(options: argparse.Namespace) -> None:
    from bayesdist.app.monitor import monitor

    print(monitor(options.run, options.new, options.output, command=options.line))


def _rotate(options: argparse.Namespace) -> None:
    from bayesdist.missions.wise.rotate import rotate

    text = rotate(
        options.file,
        options.output,
        degrees=options.angle,
        mirror=options.mirror,
        force=options.force,
    )
    print(text)


def _rvb_transform(options: argparse.Namespace) -> None:
    from bayesdist.missions.wise.rvb import transform_files

    print(transform_files(options))


def _rvb_rereference(options: argparse.Namespace) -> None:
    from bayesdist.missions.wise.rvb import rereference_files

    print(rereference_files(options))


def _simulate_acs(options: argparse.Namespace) -> None:
    from bayesdist.missions.acs.simulated_campaign import simulate_campaign

    print(simulate_campaign(options))


def _simulate_wise(options: argparse.Namespace) -> None:
    from bayesdist.missions.wise.simulated_pairs import simulate_wise_pairs

    print(simulate_wise_pairs(options))


def _init(options: argparse.Namespace) -> None:
    from bayesdist.app.init import init
    from bayesdist.app.init_columns import columns_of_options

    n = init(
        options.config,
        options.matches,
        columns=columns_of_options(options.columns),
        size=None if options.size is None else tuple(options.size),
        force=options.force,
    )
    print(f"{options.config}: for {n} matches; read it, then 'bayesdist check' it")


if __name__ == "__main__":
    sys.exit(main())
