"""Simulated WISE pairs with configurations: `bayesdist demo` and `bayesdist simulate wise`.

The demonstration calibrates pairs of W2 and compares the result with the truth.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import QTable

from bayesdist.app.commands.convert import convert
from bayesdist.app.result_files import results_text
from bayesdist.app.run import Run
from bayesdist.app.screen import number, table_text
from bayesdist.app.stages import run
from bayesdist.app.store.record import write_table, write_text
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.infer import LinearFit, Posterior
from bayesdist.missions.wise.simulate import WiseSet, simulate_wise, wise_set, write_wise_set
from bayesdist.missions.wise.simulate.bringup import DELIVERED_TURN, write_optical_model
from bayesdist.simulate import Truth

SEED = 20110201  # date of the report from which the coefficients are taken
N_STARS = 6000
SCALES = {"jwst": 0.0656, "roman": 0.1075, "tpv": 2.75}  # arcsec per pixel, by format

_PLACED = {
    "useafter": "2026-01-01T00:00:00",
    "pedigree": "DUMMY",
    "author": "bayesdist demo",
    "v2ref": 0.0,
    "v3ref": 0.0,
    "v3idlyangle": 0.0,
}
# formats of `--as`, with placeholder settings (the demo is not of these detectors)
FILES: dict[str, dict[str, Any]] = {
    "jwst": {"instrument": "NIRISS", "detector": "NIS", "filter": "CLEAR", "pupil": "F200W"}
    | _PLACED,
    "roman": {"detector": "WFI01", "optical_element": "F158"} | _PLACED,
    "tpv": {"crval": [150.0, 2.2]},
}

_CONFIG = """\
# Matched WISE {band} and 2MASS positions, simulated from the published distortion
# (WSDC D-T033, Appendix B); truth.ecsv contains the true parameters.

[data]
matches = "stars.ecsv"
simulated = true
columns = {{x="x", y="y", u="u", v="v", sigma_u="sigma_u", sigma_v="sigma_v", mag="mag"}}

[detector]
mission = "WISE"
name = "{band}"
size = [1016, 1016]
scale_mas = 2750.0

[model]
order = 4
reference_pixel = [508.5, 508.5]

[sampler]
seed = 1

[assess]
grid = [33, 33]

[[budget]]                      # zero point of 2MASS positions relative to the sky
name = "reference catalogue"
kind = "systematic"
sigma_u = 0.005
sigma_v = 0.005
unit = "pix"

[[requirement]]
name = "field-wide accuracy"
statistic = "p95"
limit = 0.03
unit = "pix"
probability = 0.95

[[requirement]]
name = "worst corner"
statistic = "max"
limit = 0.05
unit = "pix"
probability = 0.95

[products]
sip = {{inverse_order = 5, {sip}}}
"""

MIDDLE = 508.5  # pixel at which u and v of the demo are zero, as for focal-plane offsets

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


def write_simulation(
    folder: Path, matches: Matches, truth: Truth, band: str, *, sip: str = 'linear = "sip"'
) -> None:
    """Write stars.ecsv, truth.ecsv and config.toml of a simulated band.

    `sip` are settings for the SIP header in the configuration; the default is the form of WISE.
    """
    made_folder(folder)
    stars = QTable()
    for name in ("x", "y", "u", "v", "sigma_u", "sigma_v"):
        stars[name] = getattr(matches, name)
        stars[name].unit = "pix"
    stars["mag"] = matches.mag
    true = QTable({"name": list(truth.model.names), "value": truth.theta})
    true.meta = {
        "fraction": truth.fraction,
        "jitter": truth.jitter,
        "outlier_scale": truth.outlier_scale,
        "false_matches": int(truth.false.sum()),
    }
    write_table(stars, folder / "stars.ecsv")
    write_table(true, folder / "truth.ecsv")
    write_text(folder / "config.toml", _CONFIG.format(band=band, sip=sip))


def demo(folder: str | Path, *, format: str | None, force: bool, command: str) -> str:
    """Simulate pairs, calibrate them and compare with the truth; returns text to print.

    The folder contains ``input/`` and ``run/``, and ``file/`` if a format, one of `FILES`, is
    given.
    """
    folder = Path(folder)
    subfolders = {"input", "run", "file"}
    if folder.is_dir() and {p.name for p in folder.iterdir()} - subfolders:
        raise InputError(
            "the folder contains other files", where=str(folder), do="choose another one"
        )
    if (folder / "run").exists() and not force:
        raise InputError(
            "the folder contains another demo", where=str(folder), do="use --force to replace it"
        )
    matches, truth = _from_middle(*simulate_wise(N_STARS, rng=np.random.default_rng(SEED)))
    write_simulation(folder / "input", matches, truth, "W2", sip='axes = "linear"')
    run(folder / "input" / "config.toml", folder / "run", force=force, command=command)
    finished = RunDirectory.open(folder / "run")
    with Run.of(finished) as finished_run:
        against = _against_truth(finished_run.posterior, finished_run.fit, truth)
    text = f"{against}\n\n{results_text(finished)}"
    if format is None:
        return text
    written = convert(
        folder / "run",
        format,
        folder / "file",
        options=[f"{key}={value}" for key, value in FILES[format].items()],
        scale=SCALES[format],
        force=force,
    )
    return (
        f"{text}\n\n{written}\n  its scale, names and position in the focal plane are placeholders"
    )


def _from_middle(matches: Matches, truth: Truth) -> tuple[Matches, Truth]:
    """Matches and truth with u and v as offsets from the centre of the detector."""
    theta = truth.theta.copy()
    theta[[truth.model.names.index(name) for name in ("u_0_0", "v_0_0")]] -= MIDDLE
    moved = replace(matches, u=matches.u - MIDDLE, v=matches.v - MIDDLE)
    return moved, replace(truth, theta=theta)


def _against_truth(posterior: Posterior, fit: LinearFit, truth: Truth) -> str:
    rows = []
    for k, name in enumerate(posterior.model.names):
        rows.append(
            {
                "coefficient": name,
                "truth": truth.theta[k],
                "posterior mean": posterior.mean[k],
                "sd": posterior.sigma[k],
                "formal": fit.sigma[k],
                "off by (sd)": (posterior.mean[k] - truth.theta[k]) / posterior.sigma[k],
            }
        )
    true = {"f": truth.fraction, "j": truth.jitter, "s_out": truth.outlier_scale}
    for key, values in posterior.hyper.items():
        mean, sd = float(values.mean()), float(values.std(ddof=1))
        rows.append(
            {
                "coefficient": key,
                "truth": true[key],
                "posterior mean": mean,
                "sd": sd,
                "formal": None,
                "off by (sd)": (mean - true[key]) / sd,
            }
        )
    for row in rows:
        sd = row["sd"]
        places = max(0, int(np.ceil(1 - np.log10(sd))))
        row["truth"] = f"{row['truth']:.{places}f}"
        row["posterior mean"] = f"{row['posterior mean']:.{places}f}"
        row["sd"], row["formal"] = number(sd, 2), number(row["formal"], 2)
        row["off by (sd)"] = f"{row['off by (sd)']:+.2f}"
    return f"Coefficients (Legendre form, {posterior.unit})\n{table_text(rows)}"


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
