"""`bayesdist simulate acs`: write the 47 Tuc campaign and configurations for its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from bayesdist.app.screen import progress_bar, table_text
from bayesdist.app.store.record import write_text
from bayesdist.errors import InputError
from bayesdist.formats.idctab.build import idctab_from_solution
from bayesdist.formats.idctab.table import IdcTab, write_idctab
from bayesdist.infer.solution.solution import Solution
from bayesdist.missions.hst.simulate import AcsCampaign, acs_solution, simulate_acs, write_acs
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Random

START = "start_idc.fits"
REFERENCE = "F606W"  # filter in which the detector tables and the drift are fitted
SCALE_ARCSEC = 0.05
V2V3 = (257.4, 302.6)  # approximate position of the reference chip's zero point, arcsec

CONFIG = """\
# Calibrates one filter of a simulated campaign: bayesdist run THIS -o {run}
[campaign]
catalog = "catalog.parquet"
exposures = "exposures.ecsv"
lists = "lists"
simulated = true
initial_distortion = "{start}"  # a known distortion, for the matching
filter = "{filter}"
mag = [-14.0, -10.0]         # instrumental; brighter ones are saturated
q_max = 0.1

[tables]{detector}
method = "field"             # or "binned", as ACS ISR 2015-06; or "none"

[detector]
mission = "HST"
instrument = "ACS"
scale_mas = 50.0

[[chip]]
number = 2
name = "WFC2"
size = [4096.0, 2048.0]
reference_pixel = [2048.0, 1024.0]
reference = true             # its axes and zero point are the gauge

[[chip]]
number = 1
name = "WFC1"
size = [4096.0, 2048.0]
reference_pixel = [2048.0, 1024.0]

[model]
order = 5

[model.tdd]                  # before and after Servicing Mission 4
epoch0 = [2004.5, 2012.5]
breaks = [2009.4]
terms = [["u", 1, 0], ["v", 1, 0], ["v", 0, 1]]{rates}

[assess]
epoch = 2006.5
grid = [33, 17]

[[requirement]]
name = "alignment"
statistic = "p95"
limit = 0.05
unit = "pix"
"""

RELEASE = """
[products.release]
name = "acs_wfc"
reference = "{start}"        # orientation of V2 and V3
[[products.release.period]]
name = "pre"
years = [2002.2, 2009.4]
segment = 0
[[products.release.period]]
name = "post"
years = [2009.4, 2015.0]
segment = 1
"""


def simulate_campaign(
    output: str | Path,
    *,
    seed: int,
    force: bool,
    exposures: int,
    stars: int,
    filters: Sequence[str],
    secondary_exposures: int,
    false: float,
    outlying: float,
    cte: bool,
    no_tables: bool,
) -> str:
    """Simulate a campaign and write it to a folder; returns text to print."""
    folder = Path(output)
    if (folder / "lists").exists() and not force:
        raise InputError(
            "the folder contains a campaign", where=str(folder), do="use --force to replace it"
        )
    with progress_bar("exposures") as progress:
        campaign = simulate_acs(
            seed=seed,
            n_exposures=exposures,
            n_stars=stars,
            filters=tuple(filters),
            n_other=secondary_exposures,
            fine_scale=not no_tables,
            cte=cte,
            outlying=outlying,
            false=false,
            progress=progress,
        )
    write_acs(campaign, folder, force=force)
    write_idctab(_stale(), folder / START)
    filters = campaign.log.filters
    first = REFERENCE if REFERENCE in filters else filters[0]
    names = [first, *(name for name in filters if name != first)]
    for name in names:
        write_text(folder / _config_of(name), _config(name, first))
    lines = [
        f"bayesdist run {folder / _config_of(name)} -o {folder / _run(name)}" for name in names
    ]
    if len(names) > 1:
        runs = " ".join(str(folder / _run(name)) for name in names)
        lines.append(f"bayesdist release {runs} -o {folder / 'release'}")
    return (
        f"{table_text(_rows(campaign))}\n\n{folder / 'README.txt'} describes the files\n"
        "calibrate it:\n  " + "\n  ".join(lines)
    )


def _config_of(filter: str) -> str:
    return f"campaign_{filter.lower()}.toml"


def _run(filter: str) -> str:
    return f"run_{filter.lower()}"


def _config(filter: str, reference: str) -> str:
    """Configuration text; other filters take tables and drift from the run of the reference."""
    text = CONFIG + RELEASE if filter == reference else CONFIG
    is_reference = filter == reference
    return text.format(
        filter=filter,
        start=START,
        run=_run(filter),
        detector=""
        if is_reference
        else f'\ndetector = "{_run(reference)}"       # fixed; only the filter table is fitted',
        rates=""
        if is_reference
        else f'\nrates = "{_run(reference)}"          # one drift for all filters',
    )


def _stale() -> IdcTab:
    """Initial IDCTAB for the matching: the distortion of 2004.5, without drift."""
    model, theta = acs_solution()
    without_drift = replace(model, time=None)
    return idctab_from_solution(
        _Exact(without_drift, theta[: without_drift.n_params]),
        instrument="ACS",
        detector="WFC",
        scale_arcsec=SCALE_ARCSEC,
        v2ref=V2V3[0],
        v3ref=V2V3[1],
        description="Simulated: the distortion of 2004.5, without drift and tables",
    )


@dataclass(frozen=True, eq=False)
class _Exact(Solution):
    """Solution with exact parameters."""

    model: DistortionModel
    mean: Float

    @cached_property
    def cov(self) -> Float:
        return np.zeros((len(self.mean), len(self.mean)))

    def draws(self, n: int, rng: Random) -> Float:
        return np.tile(self.mean, (n, 1))


def _rows(campaign: AcsCampaign) -> list[dict[str, object]]:
    """Rows of the table of filters that is printed."""
    epochs = campaign.log.values("epoch")
    filters = np.array([item.filter for item in campaign.log])
    sizes = np.array([len(item) for item in campaign.lists])
    false = np.array([int((item.star < 0).sum()) for item in campaign.truth.detections])
    rows: list[dict[str, object]] = []
    for name in campaign.log.filters:
        in_filter = filters == name
        rows.append(
            {
                "filter": name,
                "exposures": int(in_filter.sum()),
                "first": f"{epochs[in_filter].min():.2f}",
                "last": f"{epochs[in_filter].max():.2f}",
                "detections": int(sizes[in_filter].sum()),
                "false": int(false[in_filter].sum()),
                "catalogue": len(campaign.catalog),
            }
        )
    return rows
