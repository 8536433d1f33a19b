"""Simulated input that is not specific to a mission."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from bayesdist.app.commands.options import command, force, seed
from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path


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
    from bayesdist.simulate import matched_to_gaia

    if Path(output).exists() and not force:
        raise InputError(
            "already exists", where=output, do="choose another name, or replace it with --force"
        )
    table = matched_to_gaia(stars, np.random.default_rng(seed))
    with atomic_path(output) as path:
        table.write(path, format="ascii.csv", overwrite=True)
    click.echo(f"{output}: {stars} matched stars")
