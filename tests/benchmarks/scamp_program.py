"""SCAMP on a dithered field: catalogues, passes, headers."""

from __future__ import annotations

import resource
import shutil
import subprocess
import time
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from astropy.io import votable
from numpy.typing import NDArray

from tests.benchmarks.dithered import BRIGHT, PIXEL, REACH, DitheredSky
from tests.benchmarks.ldac import (
    exposure_header,
    read_head,
    signal_to_noise,
    write_catalogues,
    write_references,
)

__all__ = ["SETTINGS", "available", "scamp_solution", "version"]

Float = NDArray[np.float64]

ARCSEC = PIXEL * 3600
CLOSE = (20.0, 2.0)  # pixels: radius of the second pass and of the last
LIMIT = 120.0  # seconds of a pass
XML = "scamp.xml"
SETTINGS = {
    "ASTREF_CATALOG": "FILE",
    "ASTREFCAT_NAME": "references.cat",
    "CENTROID_KEYS": "X_IMAGE,Y_IMAGE",
    "CENTROIDERR_KEYS": "ERRA_IMAGE,ERRB_IMAGE,ERRTHETA_IMAGE",
    "ASTRINSTRU_KEY": "INSTRUME",
    "DISTORT_KEYS": "X_IMAGE,Y_IMAGE",
    "STABILITY_TYPE": "INSTRUMENT",
    "PROJECTION_TYPE": "TPV",
    "MATCH": "N",  # pointings are known better than CROSSID_RADIUS
    "ASTR_ACCURACY": "0.001",  # pixels: the errors are right as they are
    "SOLVE_PHOTOM": "N",
    "CHECKPLOT_TYPE": "NONE",
    "CHECKPLOT_DEV": "NULL",
    "WRITE_XML": "Y",
    "XML_NAME": XML,
    "NTHREADS": "0",  # as many as there are processors
}


def available() -> bool:
    """Whether the program is installed."""
    return shutil.which("scamp") is not None


def version() -> str:
    """As the program says it."""
    run = subprocess.run(["scamp", "-v"], capture_output=True, text=True, timeout=20)
    return " ".join(run.stdout.split())


def scamp_solution(sky: DitheredSky, *more: str) -> dict[str, Any]:
    """Run SCAMP as its users do where the distortion is not known: bright stars first, then all.

    Each pass begins with the headers of the one before it.

    Parameters
    ----------
    sky : DitheredSky
    *more : str
        Settings beside `SETTINGS`: name and value in turn.

    Returns
    -------
    dict
        places, shape (E, N, 2), of the grid on the sky; seconds, cpu_s; what it says of its errors,
        in pixels on one axis: internal, reference; and the reduced chi-square.

    Raises
    ------
    RuntimeError
        With the end of its output, when it fails.
    """
    mags = sky.field.detections.mag
    assert mags is not None
    bright, faint = signal_to_noise(np.quantile(mags, [BRIGHT, 1.0]))
    order = sky.field.model.order
    passes = [(REACH, bright), (CLOSE[0], bright), (CLOSE[1], 0.9 * faint)]
    with TemporaryDirectory() as name:
        folder = Path(name)
        files = write_catalogues(sky, folder)
        write_references(sky, folder / SETTINGS["ASTREFCAT_NAME"])
        seconds = cpu = 0.0
        for radius, least in passes:
            settings = (
                SETTINGS
                | dict(zip(more[::2], more[1::2], strict=True))
                | {
                    "DISTORT_DEGREES": str(order),
                    "CROSSID_RADIUS": f"{radius * ARCSEC:g}",
                    "SN_THRESHOLDS": f"{least:g},{least:g}",
                }
            )
            took = _run(folder, files, settings)
            seconds, cpu = seconds + took[0], cpu + took[1]
            for file in files:
                head = (folder / file).with_suffix(".head")
                shutil.copy(head, head.with_suffix(".ahead"))
        places = []
        for e, file in enumerate(files):
            solved = read_head((folder / file).with_suffix(".head"), exposure_header(sky, e))
            world = solved.all_pix2world(np.column_stack(sky.grid), 1)
            places.append(sky.plane.all_world2pix(world, 1))
        told = _told(folder / XML)
    return {"places": np.stack(places), "seconds": seconds, "cpu_s": cpu} | told


def _run(folder: Path, files: list[str], settings: dict[str, str]) -> tuple[float, float]:
    """Seconds of a pass, by the clock and of the processors."""
    words = [word for name, value in settings.items() for word in (f"-{name}", value)]
    # an empty file instead of a scamp.conf that may lie about
    (folder / "none.conf").touch()
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run = subprocess.run(
        ["scamp", *files, "-c", "none.conf", *words],
        cwd=folder,
        capture_output=True,
        timeout=LIMIT,
    )
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if run.returncode:
        text = (run.stdout + run.stderr).decode("latin-1")
        raise RuntimeError(f"scamp failed ({run.returncode}):\n{text[-2000:]}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, cpu


def _told(path: Path) -> dict[str, float]:
    """What the program says of the errors of its solution."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its table is no strict VOTable
        groups = votable.parse(path).get_table_by_id("FGroups").to_table()

    def rms(name: str) -> float:
        return float(np.sqrt(np.mean(np.square(groups[name][0]))) / ARCSEC)

    return {
        "internal": rms("AstromSigma_Internal"),
        "reference": rms("AstromSigma_Reference"),
        "chi2_internal": float(groups["AstromChi2_Internal"][0]),
    }
