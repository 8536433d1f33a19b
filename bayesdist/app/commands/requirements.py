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
    """Judge a run by requirements; exit with 4 unless all are met."""
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
    help="Budget of the separation from this pixel; may be repeated.",
)
@click.option(
    "--chip", type=int, metavar="N", show_default="the only one", help="Chip of the positions."
)
@click.option("--epoch", type=float, metavar="T", help="Date in decimal years.")
@click.option(
    "--magnitude", type=float, metavar="M", help="Add the centroid error at this magnitude."
)
def budget(
    run: str,
    at: tuple[float, float],
    to: tuple[tuple[float, float], ...],
    chip: int | None,
    epoch: float | None,
    magnitude: float | None,
) -> None:
    """Print the error budget of a position, or of a separation."""
    from bayesdist.app.commands.on_runs.budget import budget_at

    click.echo(budget_at(run, at, to=list(to), chip=chip, epoch=epoch, magnitude=magnitude))
