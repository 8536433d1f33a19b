"""ACS ISR 2015-06, section 6: two exposures of a sparse field months apart, laid on each other.

Pointings and rolls are those of its Table 4.  The pixels come from the sky by inverting the true
distortion, with the centroid errors of bright and of faint stars.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesdist.calibration.calibration import Calibration, calibration_of
from bayesdist.data.tangent import mean_direction, tangent_plane
from bayesdist.diagnose.overlap import ExposureAlignment, align
from bayesdist.missions.hst.release import Period, write_release
from bayesdist.missions.hst.simulate.making import detector_tables, filter_tables
from bayesdist.model.lookup import LookupTable, corrected
from tests.reduced import only_in_full

from ...formats.acs_offline import Pointing, plane_matrix
from ...formats.acs_offline import corrected as corrected_by_stwcs
from ...formats.stwcs_offline import gnomonic
from ...formats.support import laid_on, turned_by
from .test_release import reference_of, solution_of

CENTRE = (80.8, -69.49836)
POINTINGS = (
    Pointing("2006-04-25", CENTRE, 136.97, 1.00003),
    Pointing("2006-07-11", (CENTRE[0] + 0.018, CENTRE[1] - 0.0127), -148.03 % 360, 0.99996),
)
BRIGHT, FAINT = 0.01, 0.03


@dataclass(frozen=True)
class Exposure:
    """Detections of the stars of the field: pixels (N, 2), chips, and which were seen."""

    xy: np.ndarray
    chip: np.ndarray
    seen: np.ndarray


@pytest.fixture(scope="module")
def calibration():
    """The truth: solution in V2, V3, tables, and the point it hangs on."""
    solution = solution_of("F606W", 1)
    reference = reference_of(solution)
    o = laid_on(solution, reference, epoch=2004.5, reference_drift=False, scale_arcsec=0.05)
    rng = np.random.default_rng(31)
    tables = (*detector_tables(rng), *filter_tables("F606W", rng))
    return solution, o, tables, turned_by(solution, o)


def observe(
    sky: np.ndarray,
    pointing: Pointing,
    truth: Calibration,
    tables: tuple[LookupTable, ...],
    sigma: np.ndarray,
    rng: np.random.Generator,
) -> Exposure:
    """Pixels of sky positions [deg]: the plane at CRVAL, and Newton's method back through it."""
    plane = gnomonic(sky, pointing.crval)
    o, model, epoch = truth.plane.orientation, truth.model, pointing.epoch
    centre = model.predict(truth.solution.mean, 2048.0, 1024.0, epoch=epoch, chip=2)[0]
    v2v3 = (o.v2v3[0] + centre[0], o.v2v3[1] - centre[1])
    wanted = plane @ np.linalg.inv(plane_matrix(pointing, v2v3)).T / pointing.vafactor + centre
    xy, chips = np.full((len(sky), 2), np.nan), np.zeros(len(sky), int)
    for chip in (1, 2):
        at = np.tile([2048.0, 1024.0], (len(sky), 1))

        def seen(at: np.ndarray, chip: int = chip) -> np.ndarray:
            x, y = corrected(tables, *at.T, chip=chip, filter="F606W")
            return model.predict(truth.solution.mean, x, y, epoch=epoch, chip=chip)

        for _ in range(12):
            slope = np.stack(
                [(seen(at + h) - seen(at - h)) / 2 for h in (np.array([1, 0]), np.array([0, 1]))],
                axis=2,
            )
            step = np.linalg.solve(slope, (wanted - seen(at))[..., None])[..., 0]
            at = np.clip(at + step, -1000, 6000)
        good = (at > 5).all(axis=1) & (at < [4092, 2044]).all(axis=1)
        assert np.abs(wanted - seen(at))[good].max() < 1e-9
        xy[good], chips[good] = at[good], chip
    xy = xy + rng.normal(size=xy.shape) * sigma[:, None]
    return Exposure(xy, chips, chips > 0)


@pytest.fixture(scope="module")
def field(calibration):
    """A field of stars, bright and faint, as both exposures saw it."""
    _, _, tables, truth = calibration
    rng = np.random.default_rng(32)
    n = 10000
    offset = rng.uniform(-0.03, 0.03, (n, 2)) / [np.cos(np.deg2rad(CENTRE[1])), 1]
    sky = np.array(CENTRE) + offset
    sigma = np.where(np.arange(n) % 2, BRIGHT, FAINT)
    a, b = (observe(sky, p, truth, tables, sigma, rng) for p in POINTINGS)
    both = a.seen & b.seen
    return tuple(Exposure(e.xy[both], e.chip[both], e.seen[both]) for e in (a, b)), sigma[both]


@pytest.fixture(scope="module")
def aligned(calibration, field, tmp_path_factory) -> dict[str, ExposureAlignment]:
    """Residuals with the new files, and with the old: no drift, no tables."""
    pytest.importorskip("stwcs")
    solution, o, tables, _ = calibration
    folder: Path = tmp_path_factory.mktemp("tweak")
    new = write_release(
        folder,
        "new",
        {"F606W": calibration_of(solution)},
        o,
        [Period("pre", (2002.2, 2009.39))],
        tables=tables,
    )
    stale = solution.mean.copy()
    for chip in (1, 2):
        stale[solution.model.tdd_slice(chip)] = 0.0
    old = write_release(
        folder, "old",
        {"F606W": calibration_of(type(solution)(solution.model, stale, solution.cov))}, o,
        [Period("pre", (2002.2, 2009.39))],
    )  # fmt: skip
    (a, b), _ = field
    out = {}
    for name, files in (("new", new), ("old", old)):
        wcs = [
            corrected_by_stwcs(
                folder, f"{name}{k}", pointing, idctab=files.idctabs["pre"], d2im=files.d2im,
                npol=files.npol.get("F606W"),
            )
            for k, pointing in enumerate(POINTINGS)
        ]  # fmt: skip
        sky = [sky_of(one, exposure) for one, exposure in zip(wcs, (a, b), strict=True)]
        point = mean_direction(*sky[0].T)
        planes = [np.stack(tangent_plane(*one.T, point), axis=1) / 0.05 for one in sky]
        out[name] = align(*planes)
    return out


def sky_of(wcs: Mapping[int, Any], exposure: Exposure) -> np.ndarray:
    """Right ascension and declination (N, 2) of detections by the WCS of their chips."""
    out = np.empty_like(exposure.xy)
    for number in np.unique(exposure.chip):
        rows = exposure.chip == number
        out[rows] = wcs[number].all_pix2world(exposure.xy[rows], 1)
    return out


def vectors(alignment: ExposureAlignment, sigma: np.ndarray, cells: int = 8):
    """Weighted mean residual in each cell of the overlap (M, 2), and its error (M,)."""
    p = alignment.position
    edges = [np.quantile(p[:, k], np.linspace(0, 1, cells + 1)[1:-1]) for k in (0, 1)]
    cell = np.searchsorted(edges[0], p[:, 0]) * cells + np.searchsorted(edges[1], p[:, 1])
    weight = 1 / sigma**2
    total = np.bincount(cell, weight, cells**2)
    keep = total > 2 / 0.005**2  # cells with stars enough for 0.005 px
    mean = [
        np.bincount(cell, weight * alignment.residual[:, k], cells**2)[keep] / total[keep]
        for k in (0, 1)
    ]
    # each star has the errors of two exposures
    return np.stack(mean, axis=1), np.sqrt(2 / total[keep])


@pytest.mark.slow
@only_in_full("tests/formats reads the files by stwcs")
def test_new_files_leave_the_centroid_errors_only(aligned, field) -> None:
    """Each vector of the map is noise: chi2 of residuals and of cells, and no cell over 0.02 px."""
    _, sigma = field
    residual = aligned["new"].residual
    for bright, level in ((True, BRIGHT), (False, FAINT)):
        mine = residual[(sigma == BRIGHT) == bright]
        expected = np.sqrt(2) * level
        error = expected / np.sqrt(2 * mine.size)
        assert np.sqrt(np.mean(mine**2)) == pytest.approx(expected, abs=5 * error)
    mean, error = vectors(aligned["new"], sigma)
    chi2 = np.sum((mean / error[:, None]) ** 2)
    assert chi2 / mean.size == pytest.approx(1.0, abs=5 * np.sqrt(2 / mean.size))
    assert np.hypot(*mean.T).max() < 0.02
    assert np.quantile(np.hypot(*residual[sigma == BRIGHT].T), 0.99) < 0.05


def test_old_files_leave_a_pattern(aligned, field) -> None:
    """Vectors of up to about 0.2 px that neighbours share, where the new ones share nothing."""
    _, sigma = field
    mean, error = vectors(aligned["old"], sigma)
    largest = np.hypot(*mean.T).max()
    assert 0.1 < largest < 0.4
    assert np.sum((mean / error[:, None]) ** 2) / mean.size > 100
    new, _ = vectors(aligned["new"], sigma)
    assert np.hypot(*new.T).max() < largest / 5

    def shared(alignment: ExposureAlignment) -> float:
        """Correlation of the residuals of nearest neighbours."""
        from scipy.spatial import cKDTree

        near = cKDTree(alignment.position).query(alignment.position, k=2)[1][:, 1]
        r = alignment.residual
        return float(np.sum(r * r[near]) / np.sum(r**2))

    n = len(sigma)
    assert shared(aligned["old"]) > 0.5
    assert abs(shared(aligned["new"])) < 5 / np.sqrt(n)


def test_the_fit_is_that_of_tweakwcs(aligned) -> None:
    """Shift, rotation, scale and residuals of its fit of the same positions."""
    linearfit = pytest.importorskip("tweakwcs.linearfit")
    for alignment in aligned.values():
        turn = alignment.scale * np.exp(1j * alignment.rotation)
        a = alignment.position @ [1, 1j]
        b = (a - alignment.residual @ [1, 1j] - alignment.shift @ [1, 1j]) / turn
        theirs = linearfit.fit_rscale(alignment.position, np.stack([b.real, b.imag], axis=1))
        matrix, shift = theirs["matrix"], theirs["shift"]
        ours = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
        assert np.abs(np.asarray(matrix, float) - ours).max() < 1e-12
        assert np.abs(np.asarray(shift, float) - alignment.shift).max() < 1e-8
        left = np.asarray(theirs["resids"], float)
        assert np.abs(left - alignment.residual).max() < 1e-8


def test_what_a_similarity_takes_up_is_no_residual() -> None:
    b = np.array([[1.0, 1.0], [500.0, 30.0], [40.0, 900.0], [800.0, 850.0]])
    turned = 1.001 * b @ np.array([[np.cos(0.02), np.sin(0.02)], [-np.sin(0.02), np.cos(0.02)]])
    found = align(turned + np.array([3.0, -4.0]), b)
    assert np.abs(found.residual).max() < 1e-10
    assert found.shift == pytest.approx([3.0, -4.0])
    assert (found.scale, found.rotation) == pytest.approx((1.001, 0.02))
