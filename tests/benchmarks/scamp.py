"""Self-calibration against SCAMP: the same detections, pointings and reference stars to both.

Judged are relative places over the detector, against the truth, and what each program says of its
errors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.dithered import DitheredSky, Sizes, dithered_sky, relative
from tests.benchmarks.scamp_program import available, scamp_solution, version
from tests.benchmarks.selfcal import RIGID, own_solution
from tests.benchmarks.timing import say

__all__ = ["FULL", "QUICK", "run", "summarised"]

Float = NDArray[np.float64]

FULL = Sizes((4096.0, 2048.0), 4, 82.0, 15, 3000, (1,), (0.0, 0.05))
QUICK = Sizes((1024.0, 1024.0), 2, 3.0, 6, 900, (1,), (0.05,))
ABSENT = "scamp is not installed (Debian package scamp)"
SOLUTIONS: dict[str, tuple[Callable[..., dict[str, Any]], tuple[str, ...]]] = {
    "bayesdist, rigid exposures": (own_solution, (RIGID,)),
    "bayesdist, linear exposures": (own_solution, ("affine",)),
    "SCAMP, one instrument": (scamp_solution, ()),
    "SCAMP, references of little weight": (scamp_solution, ("ASTREF_WEIGHT", "0.01")),
    "SCAMP, an instrument for each roll": (scamp_solution, ("ASTRINSTRU_KEY", "ROLLSET")),
}


def run(sizes: Sizes) -> dict[str, Any]:
    """Errors, claims and seconds of each program on each field.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    here = available()
    if not here:
        say(ABSENT)
    own_solution(dithered_sky(QUICK, 0, 0.0), "affine")  # compiled
    rows = []
    for false in sizes.false:
        for seed in sizes.seeds:
            sky = dithered_sky(sizes, seed, false)
            for name, (solve, choices) in SOLUTIONS.items():
                if solve is scamp_solution and not here:
                    continue
                row = {"solution": name, "false": false, "seed": seed}
                rows.append(row | _judged(sky, solve(sky, *choices)))
                say(
                    f"{name}, {100 * false:g} % false, seed {seed}: relative error "
                    f"{rows[-1]['rms']:.5f} pix in {rows[-1]['seconds']:.1f} s"
                )
    return {
        "rows": rows,
        "scamp": version() if here else None,
        "absent": None if here else ABSENT,
        "size": sizes.size,
        "order": sizes.order,
        "distortion": sizes.distortion,
        "exposures": sizes.exposures,
        "stars": sizes.stars,
    }


def _judged(sky: DitheredSky, found: dict[str, Any]) -> dict[str, Any]:
    """Errors of a solution and what it says of them."""
    error = found["places"] - sky.truth
    off = np.stack([relative(e, t) for e, t in zip(error, sky.truth, strict=True)])
    row = {
        "rms": _rms(off),
        "largest": float(np.hypot(*np.moveaxis(off, -1, 0)).max()),
        "absolute": _rms(error),
    }
    for name in ("seconds", "cpu_s", "internal", "reference", "chi2_internal"):
        if name in found:
            row[name] = found[name]
    if "sigma" in found:
        pull = np.abs(off[0]) / found["sigma"]
        row |= {
            "claimed": float(np.sqrt(np.mean(found["sigma"] ** 2))),
            "within": [float(np.mean(pull < k)) for k in (1, 2)],
        }
    return row


def _rms(error: Float) -> float:
    """On one axis."""
    return float(np.sqrt(np.mean(error**2)))


def summarised(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the same solution and share of false detections as one: rms or mean over the seeds.

    Parameters
    ----------
    rows : list of dict
        Of `run`.
    """
    out = []
    for key in dict.fromkeys((r["solution"], r["false"]) for r in rows):
        some = [r for r in rows if (r["solution"], r["false"]) == key]
        one: dict[str, Any] = {"solution": key[0], "false": key[1], "seeds": len(some)}
        for name in ("rms", "absolute", "claimed", "internal", "reference"):
            if name in some[0]:
                one[name] = float(np.sqrt(np.mean([r[name] ** 2 for r in some])))
        for name in ("seconds", "cpu_s", "within", "chi2_internal"):
            if name in some[0]:
                one[name] = np.mean([r[name] for r in some], axis=0).tolist()
        one["largest"] = max(r["largest"] for r in some)
        out.append(one)
    return out
