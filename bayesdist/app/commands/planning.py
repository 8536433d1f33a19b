"""Commands for planning: further exposures, and the polynomial order."""

from __future__ import annotations

import click

from bayesdist.app.commands.options import ON_RUNS, CommaList, Unused, command, force


@command(calls=f"{ON_RUNS}.plan:plan")
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
    calls=f"{ON_RUNS}.order:order",
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
