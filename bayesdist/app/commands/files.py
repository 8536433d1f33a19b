"""Commands on files: inspect, apply, convert, compare, monitor, docs, and simulate camera.

Pages of the documentation are part of the package and need no network.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import click

import bayesdist.version
from bayesdist.app.commands.options import (
    COMMANDS,
    Unused,
    command,
    epoch,
    filter_name,
    force,
    image_size,
    pixel_scale,
    seed,
)
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path
from bayesdist.files.regular import read_text

_PACKAGE = Path(bayesdist.version.__file__).parent
_FOLDERS = (_PACKAGE / "docs", _PACKAGE.parent / "docs")  # installed, and in the source tree


@command(calls=f"{COMMANDS}.inspect:inspect")
@click.argument("path", metavar="FILE", type=click.Path())
def inspect() -> None:
    """Describe a product, a posterior or a run, and report its faults."""


@command(
    unused=[
        Unused(
            "inverse method order scale origin vafactor image ltv corner",
            "with --sky",
            lambda o: o["sky"],
            "leave --sky out",
        ),
        Unused("point centroids joint", "without --sky", lambda o: not o["sky"], "add --sky"),
        Unused(
            "pixel_origin",
            "with --inverse, which writes pixels that count from 1",
            lambda o: o["inverse"],
        ),
        Unused("method", "without --inverse", lambda o: not o["inverse"], "add --inverse"),
        Unused(
            "order",
            "without --inverse --method polynomial",
            lambda o: not (o["inverse"] and o["method"] == "polynomial"),
            "add both",
        ),
    ]
)
@click.argument("file", metavar="FILE", type=click.Path())
@click.argument("table", metavar="TABLE", type=click.Path())
@filter_name
@epoch
@pixel_scale
@image_size
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    required=True,
    metavar="OUT",
    help="An .ecsv, .csv or .fits file.",
)
@click.option("--inverse", is_flag=True, help="Transform back to pixels.")
@click.option(
    "--method",
    type=click.Choice(["newton", "polynomial", "table"]),
    default="newton",
    help="Method of the inverse: Newton, a fitted polynomial, or INVERSE rows.",
)
@click.option("--order", type=int, metavar="N", help="Order of the fitted polynomial.")
@click.option("--columns", nargs=2, metavar="X Y", help="Names of the columns with positions.")
@click.option("--chip", type=int, metavar="N", help="Chip number, in place of a column.")
@click.option(
    "--origin",
    nargs=2,
    type=float,
    metavar="X Y",
    show_default="0 0",
    help="Output pixel of the zero point.",
)
@click.option(
    "--vafactor", type=float, default=1.0, metavar="V", help="Factor of velocity aberration."
)
@click.option(
    "--sky", is_flag=True, help="Transform to the sky: ra, dec with all errors stated in FILE."
)
@click.option(
    "--point", nargs=2, type=float, metavar="RA DEC", help="With --sky: position of u, v = 0."
)
@click.option(
    "--centroids", nargs=2, metavar="SX SY", help="With --sky: columns of the errors of x, y."
)
@click.option("--joint", is_flag=True, help="With --sky: the covariance of all stars, in FITS.")
@click.option(
    "--pixel-origin",
    type=click.Choice(["0", "1"]),
    help="Coordinate of the first pixel's centre (default: that of the columns' program, or 1).",
)
@click.option(
    "--image", type=click.Path(), metavar="FLT", help="Calibrated image that the pixels belong to."
)
@click.option("--ltv", nargs=2, type=float, metavar="LTV1 LTV2", help="LTV keywords of a subarray.")
@click.option("--corner", nargs=2, type=float, metavar="X Y", help="First pixel of a subarray.")
@force
def apply(file: str, table: str, output: str, **options: Any) -> None:
    """Transform pixels to the undistorted frame, or back, or to the sky.

    FILE is a run, or any file that 'compare' takes; TABLE has columns x, y, chip, or
    x_out, y_out for the inverse.
    """
    sky_options = {key: options.pop(key) for key in ("point", "centroids", "joint")}
    origin = options.pop("pixel_origin")
    origin = None if origin is None else float(origin)
    if not options.pop("sky"):
        from bayesdist.app.commands.apply import apply_to_table

        click.echo(apply_to_table(file, table, output, pixel_origin=origin, **options))
        return
    from bayesdist.app.commands.apply import sky_to_table

    shared = ("columns", "chip", "filter", "epoch", "size", "force")
    common_options = {key: options.pop(key) for key in shared}
    click.echo(
        sky_to_table(file, table, output, pixel_origin=origin, **sky_options, **common_options)
    )


@command(calls=f"{COMMANDS}.convert:convert")
@click.argument("path", metavar="FILE", type=click.Path())
@click.option("--to", required=True, metavar="FORMAT", help="Format to write, a key of [products].")
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="OUT",
    help="Folder, or file if only one is written.",
)
@click.option(
    "--option",
    "options",
    multiple=True,
    metavar="KEY=VALUE",
    help="Setting of the format, as in [products].",
)
@click.option(
    "--order",
    type=int,
    metavar="N",
    help="Polynomial order of the output (default: that of the input).",
)
@click.option("--chip", type=int, metavar="N", help="Number of the only chip to convert.")
@filter_name
@epoch
@click.option("--scale", type=float, metavar="S", help="Size of a pixel, arcsec.")
@image_size
@click.option(
    "--sample",
    is_flag=True,
    help="FILE is a header of any projection: sample it through astropy.wcs and fit a polynomial.",
)
@force
def convert() -> None:
    """Write a calibration in another format, and report what is lost.

    FILE is a run, or a file of any format that holds a calibration.
    """


@command(calls=f"{COMMANDS}.compare:compare_files", recorded=True)
@click.argument("a", metavar="A", type=click.Path())
@click.argument("b", metavar="B", type=click.Path())
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="DIR",
    help="Folder to create for tables and figure.",
)
@click.option(
    "--chip", type=int, metavar="N", show_default="all common chips", help="Chip to compare."
)
@click.option(
    "--filter", metavar="F", help="Filter or band of a file with several; F:G for A and B."
)
@epoch
@image_size
@click.option(
    "--keep-linear", "keep", is_flag=True, help="Do not remove shift, rotation and scale."
)
@click.option(
    "--grid",
    type=int,
    nargs=2,
    default=(33, 17),
    metavar="NX NY",
    help="Number of positions along x and y.",
)
def compare() -> None:
    """Compare two calibrations: differences and their significance.

    A and B are each a run, a posterior, a fit, or a file of any format that holds a calibration.
    """


@command(calls=f"{COMMANDS}.monitor:monitor", recorded=True)
@click.argument("run", metavar="RUN", type=click.Path())
@click.argument("new", metavar="NEW", type=click.Path())
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="DIR",
    help="Folder to create for tables and figure.",
)
def monitor() -> None:
    """Test whether a released calibration still describes new matches.

    NEW is a table of matches, or a CONFIG.toml, a run or a folder with a config.toml
    that names them.
    """


@command()
@click.argument("page", required=False)
def docs(page: str | None) -> None:
    """Show a page of the documentation, or list all pages."""
    pages = _pages()
    if page is None:
        width = max(map(len, pages))
        for name, path in pages.items():
            click.echo(f"{name:{width}}  {_title(read_text(path))}")
        return
    name = page.removesuffix(".md")
    if name not in pages:
        near = get_close_matches(name, pages, n=1)
        raise InputError(
            f"the documentation has no page {page!r}",
            do=f"give {near[0]!r}" if near else "list all pages with 'bayesdist docs'",
        )
    click.echo_via_pager(read_text(pages[name]))


def _title(text: str) -> str:
    """First heading of a page, or the title in its front matter."""
    first = next(line for line in text.splitlines() if line.startswith(("# ", "title:")))
    return first.removeprefix("title:").strip("#' ")


def _pages() -> dict[str, Path]:
    """Files of the documentation pages by name."""
    for folder in _FOLDERS:
        pages = {path.stem: path for path in sorted(folder.glob("*.md"))}
        if pages:
            return pages
    raise InputError("the documentation is not installed", do="install the package again")


@command(example="simulate camera -o camera_gaia.csv")
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    default="camera_gaia.csv",
    metavar="FILE.csv",
    help="File to write.",
)
@click.option(
    "--stars", type=click.IntRange(min=1), default=4000, metavar="N", help="Number of stars."
)
@seed
@force
def camera(output: str, stars: int, seed: int, force: bool) -> None:
    """Simulate one SExtractor catalogue matched to Gaia, for the quickstart."""
    import numpy as np

    from bayesdist.simulate import matched_to_gaia

    if Path(output).exists() and not force:
        raise InputError(
            "already exists", where=output, do="choose another name, or replace it with --force"
        )
    table = matched_to_gaia(stars, np.random.default_rng(seed))
    with atomic_path(output) as path:
        table.write(path, format="ascii.csv", overwrite=True)
    click.echo(f"{output}: {stars} matched stars")
