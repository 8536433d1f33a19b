"""Margins of a run against requirements, and the error budget of a position."""

from __future__ import annotations

import click

from bayesdist.app.commands.options import command

MISSED = 4  # exit code


@command()
@click.argument("run", metavar="RUN")
@click.option(
    "--requirements", required=True, metavar="REQ.toml", help="File of [[requirement]] blocks."
)
def requirements(run: str, requirements: str) -> int:
    """Margins of a run; exit 4 unless all are met."""
    from bayesdist.app.commands.on_runs.validate import validate

    text, met = validate(run, requirements)
    click.echo(text)
    return 0 if met else MISSED


@command()
@click.argument("run", metavar="RUN")
@click.option("--at", required=True, nargs=2, type=float, metavar="X Y", help="FITS 1-based pixel.")
@click.option(
    "--to",
    multiple=True,
    nargs=2,
    type=float,
    metavar="X Y",
    help="Of the difference to this pixel; may be repeated.",
)
@click.option("--chip", type=int, metavar="N", show_default="the only one")
@click.option("--epoch", type=float, metavar="T", help="Decimal years.")
@click.option("--magnitude", type=float, metavar="M", help="Adds the centroid's error.")
def budget(
    run: str,
    at: tuple[float, float],
    to: tuple[tuple[float, float], ...],
    chip: int | None,
    epoch: float | None,
    magnitude: float | None,
) -> None:
    """What the error of a position, or of a distance, is made of."""
    from bayesdist.app.commands.on_runs.budget import budget_at

    click.echo(budget_at(run, at, to=list(to), chip=chip, epoch=epoch, magnitude=magnitude))
