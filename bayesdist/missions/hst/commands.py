"""Command line for HST: handbook, pam, and the simulated campaign of ACS."""

from __future__ import annotations

from typing import Any

import click

from bayesdist.app.commands.options import (
    CommaList,
    Unused,
    command,
    epoch,
    filter_name,
    force,
    new_folder,
    pixel_scale,
    seed,
)


@command(example="hst handbook 0461802ej_idc.fits -o book --filter F475W")
@click.argument("file", metavar="FILE", type=click.Path())
@filter_name
@epoch
@pixel_scale
@new_folder
@click.option(
    "--detector",
    metavar="WFC",
    show_default="that of an IDCTAB of ACS",
    help="Detector of ACS whose published numbers are compared.",
)
@click.option("--magnification", type=float, metavar="M", help="Magnification of the vectors.")
@click.pass_obj
def handbook(line: str, file: str, output: str, **options: Any) -> None:
    """Draw figures and numbers as in the ACS handbook.

    FILE is an IDCTAB, a run, or any file that 'compare' takes.
    """
    from bayesdist.missions.hst.geometry import handbook as written

    click.echo(written(file, output, command=line, **options))


@command(example="hst pam 0461802ej_idc.fits -o pam.fits --filter F475W")
@click.argument("file", metavar="FILE", type=click.Path())
@filter_name
@epoch
@pixel_scale
@click.option(
    "-o", "--output", type=click.Path(), required=True, metavar="OUT.fits", help="File to write."
)
@click.option("--chip", type=int, metavar="N", show_default="all", help="Chip of the primary HDU.")
@click.option(
    "--image",
    type=click.Path(),
    metavar="FLT",
    help="Calibrated image (flt or flc) for which the maps are made.",
)
@force
def pam(file: str, output: str, **options: Any) -> None:
    """Write pixel area maps with their errors.

    FILE is an IDCTAB, a run, or any file that 'compare' takes.
    """
    from bayesdist.missions.hst.geometry import write_area_maps

    click.echo(write_area_maps(file, output, **options))


@command(
    name="acs",
    example="simulate acs -o campaign --exposures 12 --stars 20000",
    unused=[
        Unused(
            "secondary_exposures",
            "with a single filter",
            lambda o: len(o["filters"]) < 2,
            "name several --filters",
        )
    ],
)
@new_folder
@seed
@force
@click.option(
    "--exposures", type=int, default=110, metavar="N", help="Number of exposures in F606W."
)
@click.option(
    "--stars", type=int, default=53_900, metavar="N", help="Number of stars in the catalogue."
)
@click.option(
    "--filters",
    type=CommaList(),
    default="F606W",
    metavar="F606W,F814W",
    help="One filter or several.",
)
@click.option(
    "--secondary-exposures",
    type=int,
    default=15,
    metavar="N",
    help="Number of exposures of each further filter.",
)
@click.option("--false", type=float, default=0.05, help="Fraction of false detections.")
@click.option("--outlying", type=float, default=0.0, help="Fraction of outlying exposures.")
@click.option("--cte", is_flag=True, help="Shift stars by trailed charge.")
@click.option("--no-tables", is_flag=True, help="Omit the look-up tables.")
def simulate(output: str, **options: Any) -> None:
    """Simulate star lists, catalogue and log of the 47 Tuc campaign."""
    from bayesdist.missions.hst.simulated_campaign import simulate_campaign

    click.echo(simulate_campaign(output, **options))
