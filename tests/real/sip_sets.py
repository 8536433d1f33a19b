"""SIP headers of TESS: 16 CCDs in 108 sectors (tesswcs); those after sector 91 are predictions."""

from __future__ import annotations

import bz2
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.wcs import Sip
from numpy.typing import NDArray

from bayesdist.formats.sip.header import SipHeader

Float = NDArray[np.float64]

SIZE = (2136, 2078)  # full frames
SCIENCE = ((45, 2092), (1, 2048))  # columns and rows that see the sky
LAST_MEASURED = 91


@dataclass(frozen=True, eq=False)
class Set:
    """One CCD in one sector: its header, and the file's numbers as astropy takes them."""

    sector: int
    ccd: tuple[int, int]
    sip: SipHeader
    astropy: Sip


def read_sets(path: Path) -> list[Set]:
    """All sets of the file, in its order."""
    with bz2.open(path) as stream:
        sectors = json.load(stream)
    return [
        _set(int(sector), (camera, ccd), sectors[sector][str(camera)][str(ccd)])
        for sector in sectors
        for camera in range(1, 5)
        for ccd in range(1, 5)
    ]


def _set(sector: int, ccd: tuple[int, int], entry: dict) -> Set:
    a, b, ap, bp = (np.array(entry[f"sip_{name}"]) for name in ("a", "b", "ap", "bp"))
    crpix = (float(entry["crpix0"][0]), float(entry["crpix0"][1]))
    sip = SipHeader(
        crpix=crpix,
        crval=(float(entry["crval0"][0]), float(entry["crval0"][1])),
        cd=np.array(entry["cd"]),
        ctype=("RA---TAN-SIP", "DEC--TAN-SIP"),
        order=(len(a) - 1, len(b) - 1),
        a=_terms(a),
        b=_terms(b),
        inverse_order=(len(ap) - 1, len(bp) - 1),
        ap=_terms(ap),
        bp=_terms(bp),
        size=SIZE,
    )
    return Set(sector, ccd, sip, Sip(a, b, ap, bp, crpix))


def _terms(matrix: Float) -> dict[tuple[int, int], float]:
    n = len(matrix)
    return {(p, q): float(matrix[p, q]) for p in range(n) for q in range(n - p)}


def science_grid(nodes: int = 17) -> tuple[Float, Float]:
    """Pixels (nodes^2,) over the part that sees the sky, from corner to corner."""
    x, y = np.meshgrid(*(np.linspace(low, high, nodes) for low, high in SCIENCE))
    return x.ravel(), y.ravel()


def curved(one: Set, nodes: int = 17) -> Float:
    """Correction (2, nodes^2) in pixels without its best affine part, which is the pointing's."""
    x, y = science_grid(nodes)
    design = np.stack([np.ones_like(x), x / 1000, y / 1000], axis=1)
    U = np.stack(one.sip.forward(x, y), axis=1)
    return (U - design @ np.linalg.lstsq(design, U, rcond=None)[0]).T
