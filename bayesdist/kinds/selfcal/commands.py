"""The command `bayesdist plan-dither`."""

from __future__ import annotations

import click

from bayesdist.app.commands.options import command


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
