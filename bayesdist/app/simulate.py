"""`bayesdist simulate acs`: the 47 Tuc campaign as files."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from bayesdist.app.screen import progress_bar, table_text
from bayesdist.errors import InputError
from bayesdist.simulate.acs import AcsCampaign, simulate_acs, write_acs

__all__ = ["simulate_campaign"]


def simulate_campaign(options: argparse.Namespace) -> str:
    """Simulate, and write into a folder.

    Parameters
    ----------
    options : argparse.Namespace
        Of the command line.

    Returns
    -------
    str
        What to print.

    Raises
    ------
    InputError
        For options that cannot be used, and a folder in use.
    """
    folder = Path(options.output)
    if (folder / "lists").exists() and not options.force:
        raise InputError(
            "the folder holds a campaign", where=str(folder), do="replace it by --force"
        )
    with progress_bar("exposures") as progress:
        campaign = simulate_acs(
            seed=options.seed,
            n_exposures=options.exposures,
            n_stars=options.stars,
            filters=tuple(name.strip() for name in options.filters.split(",")),
            n_other=options.other,
            fine_scale=not options.smooth,
            cte=options.cte,
            outlying=options.outlying,
            false=options.false,
            progress=progress,
        )
    write_acs(campaign, folder, force=options.force)
    return f"{table_text(_rows(campaign))}\n\n{folder / 'README.txt'} says what the files hold"


def _rows(campaign: AcsCampaign) -> list[dict[str, object]]:
    """One row for each filter."""
    epochs = campaign.log.values("epoch")
    filters = np.array([one.filter for one in campaign.log])
    sizes = np.array([len(one) for one in campaign.lists])
    false = np.array([int((one.star < 0).sum()) for one in campaign.truth.detections])
    rows: list[dict[str, object]] = []
    for name in campaign.log.filters:
        of = filters == name
        rows.append(
            {
                "filter": name,
                "exposures": int(of.sum()),
                "first": f"{epochs[of].min():.2f}",
                "last": f"{epochs[of].max():.2f}",
                "detections": int(sizes[of].sum()),
                "false": int(false[of].sum()),
                "catalogue": len(campaign.catalog),
            }
        )
    return rows
