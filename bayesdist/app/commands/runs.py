"""Commands on runs: check, run, stages, requirements, budget, report, plan, select-order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bayesdist.app.commands.options import COMMANDS, CommaList, Unused, command, force

STAGES = ("match", "fit", "sample", "diagnose", "evaluate", "assess", "export", "report")


@command(calls=f"{COMMANDS}.check:check")
@click.argument("path", metavar="CONFIG.toml", type=click.Path())
def check() -> None:
    """Check units, rank, degeneracies and cost of a configuration, without sampling."""


@command()
@click.argument("config", metavar="CONFIG.toml", type=click.Path())
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="RUN",
    show_default="CONFIG-run",
    help="Folder of the run.",
)
@click.option("--resume", is_flag=True, help="Resume an interrupted run.")
@click.option("--force", is_flag=True, help="Replace an existing run.")
@click.option("--strict", is_flag=True, help="Exit with 3 unless converged.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    metavar="N",
    show_default="that of the configuration",
    help="Seed of the random numbers.",
)
@click.pass_obj
def run(line: str, config: str, output: str | None, **options: Any) -> None:
    """Calibrate: match, fit, sample, diagnose, evaluate, export, report."""
    if options["resume"] and options["force"]:
        raise click.UsageError("--resume and --force exclude each other.")
    from bayesdist.app.result_files import results_text
    from bayesdist.app.stages import run as whole_job
    from bayesdist.app.store.rundir import RunDirectory

    folder = f"{Path(config).with_suffix('')}-run" if output is None else output
    path = whole_job(config, folder, command=line, **options)
    click.echo(results_text(RunDirectory(path)))  # not `open`: the inputs were checked at the start


@command(
    unused=[
        Unused("strict", "by stages other than 'sample'", lambda o: o["name"] != "sample"),
        Unused("pdf", "by stages other than 'report'", lambda o: o["name"] != "report"),
    ]
)
@click.argument("name", metavar=f"[{'|'.join(STAGES)}]", type=click.Choice(STAGES))
@click.argument("run", metavar="RUN", type=click.Path())
@click.option("--strict", is_flag=True, help="For sample: exit with 3 unless converged.")
@click.option("--pdf", is_flag=True, help="For report: also draw the figures as PDF.")
def stage(name: str, run: str, strict: bool, pdf: bool) -> None:
    """Run one stage of a run again.

    match: match star lists (campaigns, self-calibrations); fit: linear fit; sample: posterior,
    resumed from its checkpoints; diagnose: tests of the residuals; evaluate: maps, budget,
    margins; assess: diagnose and evaluate; export: files for pipelines; report: report.html.
    """
    from bayesdist.app.stages import continue_stage

    continue_stage(run, name, strict=strict, pdf=pdf)


@command()
@click.argument("run", metavar="RUN", type=click.Path())
@click.option(
    "--requirements",
    type=click.Path(),
    required=True,
    metavar="REQ.toml",
    help="File with [[requirement]] blocks, for example a configuration.",
)
def requirements(run: str, requirements: str) -> int:
    """Judge a run by requirements; exit with 0 if all are met.

    The exit code is 4 if a requirement is missed, otherwise 6 if one is undecided because something
    is in doubt, otherwise 5 if one is not shown to be met.
    """
    from bayesdist.app.commands.budget import validate

    text, code = validate(run, requirements)
    click.echo(text)
    return code


@command(
    calls=f"{COMMANDS}.budget:budget_at",
    unused=[
        Unused("to", "with --at-table", lambda o: o["at_table"] is not None, "give --at"),
        Unused("columns", "without --at-table", lambda o: o["at_table"] is None),
    ],
)
@click.argument("run", metavar="RUN", type=click.Path())
@click.option("--at", nargs=2, type=float, metavar="X Y", help="FITS 1-based pixel.")
@click.option(
    "--at-table",
    type=click.Path(),
    metavar="FILE",
    help="Table of positions instead of --at; it may have a column chip.",
)
@click.option(
    "--columns",
    nargs=2,
    metavar="X Y",
    show_default="x y",
    help="Columns of the pixels in that table.",
)
@click.option(
    "--to",
    multiple=True,
    nargs=2,
    type=float,
    metavar="X Y",
    help="Budget of the separation from this pixel; may be repeated.",
)
@click.option(
    "--chip", type=int, metavar="N", show_default="the only one", help="Chip of the positions."
)
@click.option("--epoch", type=float, metavar="T", help="Date in decimal years.")
@click.option(
    "--magnitude", type=float, metavar="M", help="Add the centroid error at this magnitude."
)
@click.option("--json", "as_json", is_flag=True, help="Print every term of all positions as JSON.")
def budget() -> None:
    """Print the error budget of a position, a table of positions, or a separation."""


@command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=click.Path())
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="FILE",
    help="Page to write.  [default: reports.html]",
)
def report(runs: tuple[str, ...], output: str | None) -> None:
    """Write one page for many runs, with status, worst margin and validity of each.

    With a single run and no -o, its own report.html is made again, as by 'bayesdist stage report'.
    """
    if len(runs) == 1 and output is None:
        from bayesdist.app.stages import continue_stage

        continue_stage(runs[0], "report")
        click.echo(f"{runs[0]}/report.html")
        return
    from bayesdist.app.report import overview

    click.echo(overview(runs, output or "reports.html"))


@command(calls=f"{COMMANDS}.plan:plan")
@click.argument("run", metavar="RUN", type=click.Path())
@click.option(
    "--requirement", "name", metavar="NAME", show_default="all", help="Name of one requirement."
)
@click.option(
    "--epochs",
    type=CommaList(float),
    default=(),
    metavar="T,...",
    help="Dates of further exposures, decimal years, separated by commas.",
)
def plan() -> None:
    """Compute how many more exposures would meet the requirements."""


@command(
    calls=f"{COMMANDS}.plan:order",
    name="select-order",
    unused=[
        Unused(
            "force",
            "without an output file",
            lambda o: o["output"] is None and o["figure"] is None,
            "add -o or --figure",
        )
    ],
)
@click.argument("path", metavar="CONFIG.toml", type=click.Path())
@click.option(
    "--orders",
    nargs=2,
    type=int,
    default=(3, 9),
    metavar="LOW HIGH",
    help="Lowest and highest order to compare.",
)
@click.option(
    "--chip",
    type=int,
    metavar="N",
    show_default="the only one",
    help="Chip to use.",
)
@click.option(
    "-o", "--output", type=click.Path(), metavar="orders.ecsv", help="Write the table to a file."
)
@click.option(
    "--figure", type=click.Path(), metavar="orders.png", help="Draw the comparison into a file."
)
@force
def select_order() -> None:
    """Select the polynomial order."""
