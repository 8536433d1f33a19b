"""Exposures and dither patterns to observe, and the order to fit."""

from __future__ import annotations

import click

from bayesdist.app.commands.options import CommaList, command, force
from bayesdist.errors import InputError


@command()
@click.argument("run", metavar="RUN")
@click.option("--requirement", metavar="NAME", show_default="all", help="Name of one requirement.")
@click.option(
    "--epochs",
    type=CommaList(float),
    default=(),
    metavar="T,...",
    help="Dates of further exposures, decimal years, separated by commas.",
)
def plan(run: str, requirement: str | None, epochs: tuple[float, ...]) -> None:
    """Compute how many more exposures would meet the requirements."""
    from bayesdist.app.commands.on_runs.plan import plan as exposures_planned

    if run.endswith(".toml"):
        raise InputError(
            "is a file, not a run",
            where=run,
            do=f"compare dither patterns by 'bayesdist plan-dither {run}'",
        )
    click.echo(exposures_planned(run, name=requirement, epochs=epochs))


@command(name="plan-dither")
@click.argument("patterns", metavar="PATTERNS.toml")
@click.option(
    "-o", "--output", metavar="DIR", help="Folder to create for table, record and figure."
)
@click.pass_obj
def plan_dither(line: str, patterns: str, output: str | None) -> None:
    """Compare dither patterns for a self-calibration, without data."""
    from bayesdist.app.commands.patterns.command import plan_patterns

    click.echo(plan_patterns(patterns, output, line))


@command(name="select-order")
@click.argument("config", metavar="CONFIG.toml")
@click.option(
    "--orders",
    nargs=2,
    type=int,
    default=(3, 9),
    metavar="LOW HIGH",
    help="Lowest and highest order that are compared.",
)
@click.option(
    "--chip",
    type=int,
    metavar="N",
    show_default="the only one",
    help="Chip that is compared.",
)
@click.option("-o", "--output", metavar="orders.ecsv", help="Write the table to a file.")
@click.option("--figure", metavar="orders.png", help="Draw the comparison into a file.")
@force
def select_order(
    config: str,
    orders: tuple[int, int],
    chip: int | None,
    output: str | None,
    figure: str | None,
    force: bool,
) -> None:
    """Select the polynomial order."""
    from bayesdist.app.commands.on_runs.order import order

    click.echo(order(config, orders, chip=chip, output=output, figure=figure, force=force))
