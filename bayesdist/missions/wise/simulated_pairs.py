"""`bayesdist simulate wise`: write simulated pairs, and configurations for their calibration."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bayesdist.app.screen import table_text
from bayesdist.app.store.record import write_text
from bayesdist.errors import InputError
from bayesdist.missions.wise.demo import write_simulation
from bayesdist.missions.wise.simulate import WiseSet, simulate_wise, wise_set, write_wise_set
from bayesdist.missions.wise.simulate.optical import DELIVERED_TURN, write_optical_model

WISE_CONFIG = """\
# Calibrates WISE {band} from simulated pairs: bayesdist run THIS -o {run}
# {truth} contains the true parameters
[data]
matches = "{folder}"
simulated = true
format = "rvb"
band = "{band}"
columns = {{exposure = ""}}    # without frames: the distortion is the same in all

[detector]
mission = "WISE"
name = "{band}"
size = [{columns:.0f}, {rows:.0f}]
scale_mas = {scale_mas:.1f}

[model]
order = 4
reference_pixel = [{centre[0]}, {centre[1]}]

[fit]
clip_abs = 3.0               # pixels: the match circle in the corners

[assess]
grid = [33, 33]

[[budget]]
name = "reference catalogue"
kind = "random"
sigma_u = 0.0                # exact in the simulation; for 2MASS give its error
sigma_v = 0.0
source = "simulation"

[[requirement]]
name = "worst corner"
statistic = "max"
limit = 0.05
unit = "pix"

[products]
sip = {{inverse_order = 5, linear = "sip"}}
"""


def simulate_table(
    output: str | Path,
    *,
    stars: int = 6000,
    band: str = "W2",
    fraction: float = 0.03,
    seed: int,
    force: bool,
) -> str:
    """Write a single table of one band and its configuration; returns text to print."""
    if stars < 1 or not 0 <= fraction < 1:
        raise InputError(
            "a simulation needs stars and true matches",
            do="give --stars of at least 1 and --fraction in [0, 1)",
        )
    folder = Path(output)
    if (folder / "config.toml").exists() and not force:
        raise InputError(
            "the folder contains a configuration", where=str(folder), do="use --force to replace it"
        )
    rng = np.random.default_rng(seed)
    matches, truth = simulate_wise(stars, band=band, fraction=fraction, rng=rng)
    write_simulation(folder, matches, truth, band)
    return (
        f"{len(matches)} pairs, {int(truth.false.sum())} of them false: {folder / 'stars.ecsv'}\n"
        f"calibrate them:  bayesdist run {folder / 'config.toml'} -o {folder / 'run'}"
    )


def simulate_sets(
    output: str | Path,
    *,
    bands: Sequence[str],
    pairs: int | None,
    false_fraction: float,
    partition_pattern: bool,
    seed: int,
    force: bool,
) -> str:
    """Write full sets of bands in Parquet and their configurations; returns text to print."""
    folder = Path(output)
    if len(set(bands)) < len(bands):
        raise InputError("a band is given twice", where="--bands", do="give each band once")
    sets = [
        wise_set(
            band,
            pairs=pairs,
            seed=seed,
            false_fraction=false_fraction,
            partition=partition_pattern,
        )
        for band in bands
    ]
    names = [wise_band_set.band.lower() for wise_band_set in sets]
    used = [name for name in ("config.toml", *names) if (folder / name).exists()]
    if used and not force:
        raise InputError(
            f"the folder contains {used[0]} already",
            where=str(folder),
            do="use --force to replace it",
        )
    rows: list[dict[str, object]] = []
    lines = []
    for wise_band_set, name in zip(sets, names, strict=True):
        n_false = write_wise_set(wise_band_set, folder, threads=os.cpu_count() or 1, force=force)
        write_text(folder / f"{name}.toml", _wise_config(wise_band_set))
        blocks = 0 if wise_band_set.pattern is None else wise_band_set.pattern.blocks
        rows.append(
            {
                "band": wise_band_set.band,
                "pairs": wise_band_set.pairs,
                "false": n_false,
                "partition": f"{blocks} x {blocks}" if blocks else "none",
            }
        )
        lines.append(f"bayesdist run {folder / f'{name}.toml'} -o {folder / f'run_{name}'}")
    write_optical_model(folder / "optical_w2.hdr")
    runs = " ".join(str(folder / f"run_{name}") for name in names)
    compare = (
        f"compare them:\n  bayesdist wise bands {runs} -o {folder / 'bands'} "
        f"--optical {folder / 'optical_w2.hdr'} --rotation {DELIVERED_TURN}"
    )
    return f"{table_text(rows)}\n\ncalibrate them:\n  " + "\n  ".join([*lines, compare])


def _wise_config(one: WiseSet) -> str:
    name = one.band.lower()
    array = one.array
    return WISE_CONFIG.format(
        band=one.band,
        folder=name,
        run=f"run_{name}",
        truth=f"truth/{name}.ecsv",
        columns=array.size[0],
        rows=array.size[1],
        centre=array.centre,
        scale_mas=1000.0 * array.scale,
    )
