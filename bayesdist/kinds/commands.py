"""Commands that only one kind of run has: init, plan-dither, release."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bayesdist.app.commands.options import column_names, command, force, new_folder


@command(example="init camera.toml --matches stars.csv --size 2048 2048")
@click.argument("config", metavar="CONFIG.toml", type=click.Path())
@click.option(
    "--matches", type=click.Path(), metavar="FILE", help="Table of matched stars (required)."
)
@click.option(
    "--columns",
    type=column_names,
    metavar="KEY=NAME,...",
    help="Names of columns that are not recognised; KEY= leaves one out.",
)
@click.option(
    "--size",
    nargs=2,
    type=int,
    metavar="NX NY",
    show_default="guessed from the positions",
    help="Number of columns and rows of each chip.",
)
@force
def init(config: str, matches: str | None, **options: Any) -> None:
    """Write a commented configuration for a table of matched stars."""
    if matches is None:
        toml = Path(config).with_suffix(".toml").name
        table = config if toml != Path(config).name else "stars.csv"
        raise click.UsageError(
            f"--matches names the table: bayesdist init {toml} --matches {table}. Each row is a "
            "star with its pixel and its reference position; match two lists first (bayesdist "
            "docs your_table). A list without reference positions gives a draft."
        )
    from bayesdist.kinds.matches.init import init as write_configuration

    click.echo(write_configuration(config, matches, **options))


@command(
    calls="bayesdist.kinds.selfcal.patterns.command:plan_patterns",
    example="plan-dither patterns.toml",
    recorded=True,
    name="plan-dither",
)
@click.argument("path", metavar="PATTERNS.toml", type=click.Path())
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="DIR",
    help="Folder to create for table, record and figure.",
)
def plan_dither() -> None:
    """Compare dither patterns for a self-calibration, without data."""


@command(
    calls="bayesdist.kinds.campaign.release:release_runs",
    example="release camera-run -o release",
    recorded=True,
)
@click.argument("runs", nargs=-1, required=True, metavar="RUN...", type=click.Path())
@new_folder
@click.option(
    "--allow-unconverged", is_flag=True, help="Also release runs that have not converged."
)
def release() -> None:
    """Write one set of files from the runs of several filters.

    The first run is that of the reference filter.
    """
