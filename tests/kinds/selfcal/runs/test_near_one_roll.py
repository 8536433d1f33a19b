"""Rolls that hardly differ: what is held, what is called free and what has errors are one thing.

From rolls that scatter by a few thousandths of a degree a skew is known to some pixels at the edge
of the detector, which is about where it begins to count as free.
"""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table, vstack
from scipy import stats

from bayesdist.infer.solution.transforms import gauge_free
from tests.kinds.selfcal.runs.support import fitted, write_selfcal
from tests.reduced import case_in_full

N, GAP, SIGMA = 1024, 1030.0, 0.02
MIDDLE = (N + 1) / 2
ENDS = "rolls that scatter least and most are run"


def _on_sky(bends, chip, x, y):
    """The true camera, in pixels: a linear map, terms of second and third order, and a gap."""
    X, Y = (x - MIDDLE) / (N / 2), (y - MIDDLE) / (N / 2)
    terms = np.stack([X**2, X * Y, Y**2, X**3, X**2 * Y, X * Y**2, Y**3])
    linear = [x - MIDDLE + 0.003 * (y - MIDDLE), 1.002 * (y - MIDDLE) - 0.001 * (x - MIDDLE)]
    return np.stack(linear, axis=-1) + (bends[chip] @ terms).T + chip * np.array([3.0, GAP])


def _observed(seed, scatter_deg, n_chips):
    """Detections of ten exposures, and the bends of each chip (chips, 2, 7)."""
    rng = np.random.default_rng(seed)
    rolls = np.radians(scatter_deg) * rng.standard_normal(10)
    pointings = rng.uniform(-300, 300, (10, 2))
    bends = 2.0 * rng.standard_normal((n_chips, 2, 7))
    sky = rng.uniform([-1100, -1100], [1100, 1100 + GAP * (n_chips - 1)], (900, 2))
    mag, tables = rng.uniform(-14, -10, len(sky)), []
    for e, (roll, pointing) in enumerate(zip(rolls - rolls[0], pointings, strict=True)):
        turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
        plane = (sky - pointing + pointings[0]) @ turn
        for chip in range(n_chips):
            near = (np.abs(plane - [0, chip * GAP]) < 0.55 * N).all(axis=1)
            x, y = plane[near].T + MIDDLE - [[0], [chip * GAP]]
            for _ in range(30):
                left = plane[near] - _on_sky(bends, chip, x, y)
                x, y = x + left[:, 0], y + left[:, 1]
            seen = (np.abs(x - MIDDLE) < N / 2) & (np.abs(y - MIDDLE) < N / 2)
            x, y = (z[seen] + SIGMA * rng.standard_normal(seen.sum()) for z in (x, y))
            columns = {"x": x, "y": y, "mag": mag[near][seen]}
            same = {"exposure": f"e{e}", "chip": chip + 1}
            tables.append(Table(columns | {k: [v] * len(x) for k, v in same.items()}))
    return vstack(tables), bends


def _calibrated(folder, seed, scatter_deg, n_chips):
    table, bends = _observed(seed, scatter_deg, n_chips)
    given = {"size": (float(N), float(N)), "reference_pixel": (MIDDLE, MIDDLE)}
    if n_chips == 1:
        table.remove_column("chip")
        sections = {
            "detector": {"size": given["size"]},
            "model": {"order": 3, "reference_pixel": given["reference_pixel"]},
        }
    else:
        numbers = range(1, n_chips + 1)
        sections = {
            "detector": {},
            "model": {"order": 3},
            "chip": [{"number": k, "name": f"C{k}", **given} for k in numbers],
        }
    config = write_selfcal(folder / "input", table, selfcal={"start_radius": 8.0}, **sections)
    return fitted(folder / "run", config), bends


@pytest.mark.parametrize(
    ("seed", "n_chips", "scatter_deg"),
    [
        case_in_full(2, 2, 0.001, instead="one chip is run"),
        case_in_full(2, 2, 0.0015, instead=ENDS),
        case_in_full(2, 2, 0.003, instead=ENDS),
        case_in_full(2, 2, 0.005, instead="one chip is run"),
        (2, 1, 0.005),
        case_in_full(5, 1, 0.005, instead="another seed is run"),
    ],
)
def test_what_is_held_is_free_in_every_covariance(tmp_path, seed, n_chips, scatter_deg):
    run, bends = _calibrated(tmp_path, seed, scatter_deg, n_chips)
    model, gauge, fit = run.fit.model, run.parts["solved"].gauge, run.fit
    summary = run.directory.summary["selfcal"]["gauge"]
    without_error = {model.names[k] for k in np.flatnonzero(np.diag(fit.cov) == 0)}
    assert set(summary["held"]) == without_error
    assert len(without_error) == gauge.null.shape[1] == summary["n_free"]
    by_convention = {d["name"] for d in summary["directions"] if d["fixed_by"] == "convention"}
    assert {"zero_point_u", "zero_point_v", "scale", "rotation"} <= by_convention
    # the chips lie to each other as their stars say
    assert not any(name.startswith("C2") for name in by_convention)
    # nothing is given that could fix anything
    assert not any("fixed by" in text for text in gauge.sentences)

    at = (np.arange(20) + 0.5) * N / 20 + 0.5
    x, y = (z.ravel() for z in np.meshgrid(at, at))
    first, off, J = np.zeros(len(x), np.int64), [], []
    for code, chip in enumerate(model.chips):
        where = {"exposure": first, "chip": np.full(len(x), chip.number)}
        off.append(_on_sky(bends, code, x, y) - model.predict(fit.mean, x, y, **where))
        J.append(model.jacobian(fit.mean, x, y, **where))
    off, J = np.ravel(off), np.reshape(J, (-1, model.n_params))
    free = J @ gauge.null
    off = off - free @ np.linalg.lstsq(free, off, rcond=None)[0]
    values, vectors = np.linalg.eigh(J @ gauge_free(fit, gauge.null).cov @ J.T)
    n = model.n_polynomial - gauge.null.shape[1]
    assert values[-n] > 0 and values[:-n].max() < 1e-9 * values[-1]
    chi2 = ((vectors[:, -n:].T @ off) ** 2 / values[-n:]).sum()
    low, high = stats.chi2.ppf([0.001, 0.999], n)
    assert low < chi2 < high
