"""Command line for WISE: demo, bands, bring-up, rotate, rvb, and simulated pairs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

from bayesdist.app.commands.options import (
    CommaList,
    Unused,
    column_names,
    command,
    force,
    new_folder,
    seed,
)


def _number(
    *names: str, help: str, default: float = 0.0, metavar: str = "A"
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Option that takes a number."""
    return click.option(*names, type=float, default=default, metavar=metavar, help=help)


_optical_rotation = _number(
    "--rotation", metavar="DEG", help="Rotation of the optical model, degrees."
)
_rotation_of_nothing = Unused(
    "rotation", "without an optical model", lambda o: not o["optical"], "add --optical"
)


@command(example="demo -o demo")
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    default="bayesdist-demo",
    metavar="DIR",
    help="Folder to create.",
)
@click.option(
    "--as",
    "format",
    type=click.Choice(["jwst", "roman", "tpv"]),
    help="Also write the result in this format.",
)
@click.option("--force", is_flag=True, help="Replace an earlier demo.")
@click.pass_obj
def demo(line: str, output: str, format: str | None, force: bool) -> None:
    """Calibrate simulated data and compare with the truth."""
    from bayesdist.missions.wise.simulated_pairs import demo as simulated_and_run

    click.echo(simulated_and_run(output, format=format, force=force, command=line))


@command(example="wise bands w1-run w2-run -o bands", unused=[_rotation_of_nothing])
@click.argument("runs", nargs=-1, required=True, metavar="RUN...", type=click.Path())
@new_folder
@click.option("--bins", type=int, default=31, metavar="N", help="Number of residual bins per axis.")
@click.option(
    "--optical",
    type=CommaList(),
    default=(),
    metavar="FILE,...",
    help="SIP header or WISE meta-data of an optical model; one for all runs, or one per run.",
)
@_optical_rotation
@click.option("--no-published", is_flag=True, help="Omit the published values of WISE.")
@click.pass_obj
def bands(
    line: str,
    runs: tuple[str, ...],
    output: str,
    bins: int,
    optical: tuple[str, ...],
    rotation: float,
    no_published: bool,
) -> None:
    """Compare bands: tables and figures.

    Each RUN is a finished run of a different band.
    """
    from bayesdist.missions.wise.bands.command import bands_of_runs

    text = bands_of_runs(
        runs,
        output,
        bins=bins,
        optical=optical,
        rotation=rotation,
        published=not no_published,
        command=line,
    )
    click.echo(text)


@command(
    example="wise bring-up detections.ecsv reference.ecsv -o w2 --band W2",
    name="bring-up",
    unused=[_rotation_of_nothing],
)
@click.argument("detections", metavar="DETECTIONS", type=click.Path())
@click.argument("reference", metavar="REFERENCE", type=click.Path())
@new_folder
@click.option("--band", required=True, metavar="W1", help="Band of the detections.")
@click.option("--order", type=int, default=4, metavar="N", help="Final order of the polynomial.")
@_number("--radius", default=1.0, help="Acceptance radius of pairs at the array's centre, pixels.")
@_number("--corner-radius", default=3.0, help="Acceptance radius in the corners, pixels.")
@click.option(
    "--optical", metavar="FILE", help="SIP header or WISE meta-data of the initial distortion."
)
@_optical_rotation
@click.pass_obj
def bring_up(line: str, detections: str, reference: str, output: str, **options: Any) -> None:
    """Determine pairs and distortion from unmatched star lists.

    DETECTIONS and REFERENCE have columns x, y, sigma and frame, in pixels of the band.
    """
    from bayesdist.missions.wise.bring_up import bring_up_files

    click.echo(bring_up_files(detections, reference, output, command=line, **options))


@command(example="wise rotate codev.hdr --angle 270 -o turned.hdr")
@click.argument("file", metavar="FILE", type=click.Path())
@_number("--angle", metavar="DEG", help="Angle from x towards y, degrees.")
@click.option("--mirror", is_flag=True, help="Reverse x before the rotation.")
@click.option(
    "-o", "--output", type=click.Path(), required=True, metavar="OUT", help="File to write."
)
@force
def rotate(file: str, output: str, angle: float, mirror: bool, force: bool) -> None:
    """Rotate the pixel frame of a SIP header or of WISE meta-data."""
    from bayesdist.missions.wise.rotate import rotate as write_rotated

    click.echo(write_rotated(file, output, degrees=angle, mirror=mirror, force=force))


@click.group(epilog="Example: bayesdist wise rvb transform pairs.tbl -o moved --fit")
def rvb() -> None:
    """Transform the reference positions of WISE's RvB pairs."""


def _pairs(function: Callable[..., None]) -> Callable[..., None]:
    """Decorator that adds the common argument and options of both commands."""
    for decorate in (
        click.option(
            "--columns",
            type=column_names,
            metavar="KEY=NAME,...",
            help="Names of columns, as in data.columns.",
        ),
        click.option("--band", metavar="W1", help="Band; required if the files contain several."),
        new_folder,
        click.argument("files", nargs=-1, required=True, metavar="FILE...", type=click.Path()),
    ):
        function = decorate(function)
    return function


@command(
    example="wise rvb transform pairs.tbl -o moved --fit",
    unused=[Unused("dx dy rotation scale_x scale_y", "with --fit", lambda o: o["fit"])],
)
@_pairs
@_number("--dx", help="Shift along x, pixels.")
@_number("--dy", help="Shift along y, pixels.")
@_number("--rotation", metavar="DEG", help="Rotation about the centre, from x towards y, degrees.")
@_number("--scale-x", help="Scale of x minus 1: 1e-4 stretches x by this fraction.")
@_number("--scale-y", help="Scale of y minus 1.")
@click.option("--fit", is_flag=True, help="Fit these five parameters by least squares.")
def transform(files: tuple[str, ...], output: str, **options: Any) -> None:
    """Transform all pairs by one linear transformation.

    FILE is an IPAC table, Parquet, or a folder.
    """
    from bayesdist.missions.wise.rvb import transform_files

    click.echo(transform_files(files, output, **options))


@command(example="wise rvb rereference pairs.tbl --from free.ecsv --to fixed.ecsv -o pairs")
@_pairs
@click.option(
    "--from",
    "free",
    required=True,
    metavar="TABLE",
    help="Frame solutions with which the pairs were made.",
)
@click.option(
    "--to", "fixed", required=True, metavar="TABLE", help="Frame solutions to transform them to."
)
def rereference(files: tuple[str, ...], output: str, **options: Any) -> None:
    """Transform the pairs of each frame from one solution to another."""
    from bayesdist.missions.wise.rvb import rereference_files

    click.echo(rereference_files(files, output, **options))


rvb.add_command(transform)
rvb.add_command(rereference)


def _one_table(options: Mapping[str, Any]) -> bool:
    """True if one small table is requested."""
    return any(options[name] is not None for name in ("stars", "band", "fraction"))


@command(
    name="wise",
    example="simulate wise -o w1 --bands W1 --pairs 5000",
    unused=[
        Unused(
            "bands pairs false_fraction partition_pattern",
            "for one small table (--stars, --band or --fraction)",
            _one_table,
            "omit these options",
        )
    ],
)
@new_folder
@seed
@force
@click.option(
    "--bands",
    type=CommaList(),
    default="W1,W2,W3,W4",
    metavar="W1,...",
    help="Bands of the full sets.",
)
@click.option(
    "--pairs",
    type=int,
    metavar="N",
    show_default="as published",
    help="Number of pairs in each band.",
)
@_number("--false-fraction", default=0.03, metavar="F", help="Fraction of false matches.")
@click.option("--partition-pattern", is_flag=True, help="Add a block pattern to the residuals.")
@click.option(
    "--stars", type=int, metavar="N", help="Make a single table of one band with N stars instead."
)
@click.option("--band", metavar="W2", help="Band of the small table.")
@click.option("--fraction", type=float, help="Fraction of false matches in the small table.")
def simulate(
    output: str,
    seed: int,
    force: bool,
    stars: int | None,
    band: str | None,
    fraction: float | None,
    **options: Any,
) -> None:
    """Simulate matched stars of WISE and 2MASS, with a configuration."""
    from bayesdist.missions.wise.simulated_pairs import simulate_sets, simulate_table

    if stars is None and band is None and fraction is None:
        click.echo(simulate_sets(output, seed=seed, force=force, **options))
        return
    asked: Mapping[str, Any] = {"stars": stars, "band": band, "fraction": fraction}
    small_table = {name: value for name, value in asked.items() if value is not None}
    click.echo(simulate_table(output, seed=seed, force=force, **small_table))
