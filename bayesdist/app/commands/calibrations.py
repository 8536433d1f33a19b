"""Calibrations, in whatever file or run they are: shown, applied, compared, watched, released."""

from __future__ import annotations

from typing import Any

import click

from bayesdist.app.commands.options import (
    command,
    epoch,
    filter_name,
    force,
    image_size,
    new_folder,
    pixel_scale,
)


@command()
@click.argument("file", metavar="FILE")
def inspect(file: str) -> None:
    """What a product or a posterior holds, and its faults."""
    from bayesdist.app.commands.on_files.inspect import inspect as described

    click.echo(described(file))


@command()
@click.argument("file", metavar="FILE")
@click.argument("table", metavar="TABLE")
@filter_name
@epoch
@pixel_scale
@image_size
@click.option("-o", "--output", required=True, metavar="OUT", help="An .ecsv, .csv or .fits file.")
@click.option("--inverse", is_flag=True, help="Back to pixels.")
@click.option(
    "--method",
    type=click.Choice(["newton", "polynomial", "table"]),
    default="newton",
    help="Of the inverse: by Newton, by a polynomial fitted here, by INVERSE rows.",
)
@click.option("--order", type=int, metavar="N", help="Of the polynomial fitted.")
@click.option("--columns", nargs=2, metavar="X Y", help="Names of the positions.")
@click.option("--chip", type=int, metavar="N", help="In place of a column.")
@click.option(
    "--origin",
    nargs=2,
    type=float,
    metavar="X Y",
    show_default="0 0",
    help="Output pixel of the zero point.",
)
@click.option("--vafactor", type=float, default=1.0, metavar="V", help="Of the exposure.")
@click.option("--image", metavar="FLT", help="A calibrated image whose pixels these are.")
@click.option("--ltv", nargs=2, type=float, metavar="LTV1 LTV2", help="Of a subarray.")
@click.option("--corner", nargs=2, type=float, metavar="X Y", help="First pixel of a subarray.")
@force
def apply(file: str, table: str, output: str, **options: Any) -> None:
    """Pixels to the undistorted frame, or back.

    FILE is an IDCTAB, a run, or whatever 'compare' takes; TABLE has the columns x, y, chip, or
    x_out, y_out on the way back.
    """
    from bayesdist.app.commands.on_files.apply import apply_to_table

    click.echo(apply_to_table(file, table, output, **options))


@command()
@click.argument("file", metavar="FILE")
@click.option("--to", required=True, metavar="FORMAT", help="As the table of [products].")
@click.option("-o", "--output", metavar="OUT", help="A folder, or the file where there is one.")
@click.option(
    "--option",
    "options",
    multiple=True,
    metavar="KEY=VALUE",
    help="Of the format, as in its table of [products].",
)
@click.option("--order", type=int, metavar="N", help="Of the polynomial, if another is wanted.")
@click.option("--chip", type=int, metavar="N", help="This one alone.")
@filter_name
@epoch
@click.option("--scale", type=float, metavar="S", help="Arcseconds in a pixel.")
@image_size
@force
def convert(file: str, to: str, output: str | None, **options: Any) -> None:
    """A calibration in another format, and what is lost by it.

    FILE is a run, or a file of any format that holds a calibration.
    """
    from bayesdist.app.commands.on_files.convert import convert as converted

    click.echo(converted(file, to, output, **options))


@command()
@click.argument("a", metavar="A")
@click.argument("b", metavar="B")
@click.option("-o", "--output", metavar="DIR", help="A new folder for tables and figure.")
@click.option("--chip", type=int, metavar="N", show_default="all common chips")
@click.option("--filter", metavar="F", help="Of IDCTABs, or WISE band; F:G for A and B.")
@epoch
@image_size
@click.option("--keep-linear", is_flag=True, help="Leave shift, rotation and scale in.")
@click.option("--grid", type=int, nargs=2, default=(33, 17), metavar="NX NY")
@click.pass_obj
def compare(
    line: str, a: str, b: str, output: str | None, keep_linear: bool, **options: Any
) -> None:
    """How two calibrations differ, and how significantly.

    A and B are each a run, a posterior, a fit, or a file of any format that holds a calibration.
    """
    from bayesdist.app.commands.on_runs.compare import compare_files

    click.echo(compare_files(a, b, output, keep=keep_linear, command=line, **options))


@command()
@click.argument("run", metavar="RUN")
@click.argument("new", metavar="NEW")
@click.option("-o", "--output", metavar="DIR", help="A new folder for tables and figure.")
@click.pass_obj
def monitor(line: str, run: str, new: str, output: str | None) -> None:
    """Does a released solution still describe new matches?

    NEW is a table of matches, or a CONFIG.toml that names them.
    """
    from bayesdist.app.commands.on_runs.monitor import monitor as watched

    click.echo(watched(run, new, output, command=line))


@command()
@click.argument("runs", nargs=-1, required=True, metavar="RUN...")
@new_folder
@click.option("--allow-unconverged", is_flag=True, help="Also runs that have not converged.")
@click.pass_obj
def release(line: str, runs: tuple[str, ...], output: str, allow_unconverged: bool) -> None:
    """One set of files from the runs of several filters.

    The first run is that of the reference filter.
    """
    from bayesdist.app.commands.on_runs.release import release_runs

    click.echo(release_runs(runs, output, allow_unconverged=allow_unconverged, command=line))
