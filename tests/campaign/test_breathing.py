"""21 exposures whose scale and shears breathe with the tails of Student's t, some held out.

The data are made with numpy (tests/adversarial); none of it is the package's simulator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayesdist.infer.solution.transforms import reference_gauge, without_frames
from tests.adversarial.campaign_kinds import chip_by_chip, drift
from tests.adversarial.campaign_measure import assessed
from tests.adversarial.campaign_truth import EPOCH0, Recipe, made
from tests.adversarial.exposure_kinds import BREATHING
from tests.adversarial.truth import TWO
from tests.app.support import summary_of
from tests.reduced import only_in_full

EXPOSURES, SEEDS = 21, 6
HOLDOUT = {"fraction": 0.1, "exposures": 3}
DATES = (EPOCH0, 2003.0, 2011.0)


def breathing(rng, n):
    """Scale and shears (n, 3) with the scatter `BREATHING`: t of 3 has the variance 3."""
    return BREATHING * rng.standard_t(3, (n, 3)) / np.sqrt(3)


def pulls_of(seed: int, folder: Path) -> tuple[dict, np.ndarray]:
    """Summary of a run, and pulls of the coefficients of both chips at several dates."""
    rng, drawn = np.random.default_rng(1000 + seed), []

    def deviations(rng, n):
        drawn.append(breathing(rng, n))
        return drawn[0]

    rate = chip_by_chip(drift(rng))
    truth = made(rng, Recipe(chips=TWO, exposures=EXPOSURES, deviations=deviations, rate=rate))
    truth.config["holdout"] = HOLDOUT
    run = assessed(truth, folder, seed)
    scale, plus, cross = drawn[0][EXPOSURES]
    own = np.linalg.inv([[1 + scale + plus, cross], [cross, 1 + scale - plus]])
    view = reference_gauge(without_frames(run.solution), run.fit.model.chips[0].number)
    draws = rng.multivariate_normal(view.mean, view.cov, 2000, method="svd")
    frame, out = None, []
    for date in DATES:
        for chip in view.model.chips:  # the reference chip first: its zero point and axes
            piece = next(one for one in truth.chips if one.number == chip.number)
            x, y = (
                a.ravel()
                for a in np.meshgrid(
                    np.linspace(1, piece.columns, 14), np.linspace(1, piece.rows, 12)
                )
            )
            true = truth.true_map(*piece.mosaic(x, y), date) @ own.T
            if frame is None:
                frame = _frame(x - chip.reference_pixel[0], y - chip.reference_pixel[1], true)
            true = (true - frame[0]) @ frame[1].T
            project = np.linalg.pinv(view.model.basis(chip.number).evaluate(x, y))
            seen = view.model.predict(draws, x, y, chip=chip.number, epoch=np.full(x.size, date))
            found = np.einsum("kn,dna->dka", project, seen)
            sigma = found.std(axis=0)
            free = sigma > 1e-9
            out.append(((found.mean(axis=0) - project @ true) / np.where(free, sigma, 1.0))[free])
    return summary_of(run.directory.path), np.concatenate(out)


def _frame(x, y, w):
    """Zero point, and the rotation by which u does not depend on y there."""
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    design = np.stack([(x / 500) ** i * (y / 500) ** j for i, j in powers], axis=1)
    c = np.linalg.lstsq(design, w, rcond=None)[0]
    a = np.arctan2(*c[powers.index((0, 1))])
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return c[powers.index((0, 0))], turn


@pytest.mark.slow
@only_in_full("test_campaign_holdout holds exposures out, test_hierarchy has some that went wrong")
def test_heavy_tails_and_exposures_held_out_go_through(tmp_path, full):
    """Pulls of one run are correlated: some forty free directions in 120 numbers of each."""
    pulls = []
    for seed in range(1, SEEDS + 1 if full else 2):
        folder = tmp_path / str(seed)
        folder.mkdir()
        found, some = pulls_of(seed, folder)
        assert found["sampler"]["converged"] and found["holdout"]["level"] in ("pass", "warn")
        pulls.append(some)
    square = np.mean(np.concatenate(pulls) ** 2)
    # a chi-square of 40 numbers a run has the standard deviation sqrt(80); four of them
    assert abs(square - 1) < 4 * np.sqrt(2 / (40 * len(pulls)))
    assert np.abs(np.concatenate(pulls)).max() < 5
