"""`bayesdist demo`: calibrate simulated WISE W2 pairs and compare the result with the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import QTable

from bayesdist.app.commands.on_files.convert import convert
from bayesdist.app.run import Run
from bayesdist.app.screen import number, table_text
from bayesdist.app.stages import run
from bayesdist.app.store.output import write_table
from bayesdist.app.store.record import write_text
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.app.tables.margins import results_text
from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.infer import LinearFit, Posterior
from bayesdist.missions.wise.simulate import simulate_wise
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
