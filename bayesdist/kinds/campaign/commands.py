"""The command `bayesdist release`."""

from __future__ import annotations

import click

from bayesdist.app.commands.options import command, new_folder


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
