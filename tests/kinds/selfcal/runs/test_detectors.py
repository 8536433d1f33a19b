"""Two chips that nobody has measured, dates and VAFACTOR, a start from an earlier run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from astropy.wcs import WCS
from scipy import stats

from bayesdist.app.cli import main
from bayesdist.app.store.record import write_table
from bayesdist.data.sky import parallax_factors
from bayesdist.infer import load_fit
from bayesdist.kinds.selfcal.fit import SelfCalibrated, star_table
from bayesdist.kinds.selfcal.infer import star_catalogue
from bayesdist.kinds.selfcal.infer.gauge import functionals
from bayesdist.kinds.selfcal.patterns.exposures import pixels_of
from tests.app.support import refused
from tests.kinds.selfcal.infer.fields import SIZE, chips, field
from tests.kinds.selfcal.runs.support import (
    SCALE_MAS,
    directions,
    fitted,
    list_table,
    small,
    write_selfcal,
)

EPOCHS = np.linspace(2002.0, 2006.0, 8)
RA, DEC = 17.5, -72.0


def test_chips_lie_as_their_stars_say(tmp_path):
    """The gap of 50 pixels between them is found from the stars, and is no matter of the gauge."""
    truth = field(7, 8, 1200, n_chips=2, rolls=(0, 60, 130), disturbed=0.02)
    blocks = [
        {"number": c.number, "name": c.name, "size": c.size, "reference_pixel": c.reference_pixel}
        for c in chips(2)
    ]
    blocks[0]["reference"] = True
    config = write_selfcal(
        tmp_path / "input", list_table(truth), chip=blocks, detector=None, model={"order": 3}
    )
    run = fitted(tmp_path / "run", config)
    found = directions(run)
    model, theta = run.fit.model, run.parts["solved"].mode.theta
    rows = functionals(truth.model, truth.theta)
    # by how much the solution differs from the truth in what both chips say of each other
    off = {name: rows[name] @ (_as_true(run, truth) - truth.theta) for name in rows}
    for name in ("C2.shift_u", "C2.shift_v", "C2.rotation", "C2.scale"):
        assert found[name]["state"] == "known" and found[name]["fixed_by"] == "detections"
        assert abs(off[name]) < 4 * found[name]["sigma_detections"], name
    gap = model.predict(theta, [512.0], [512.0], chip=2) - model.predict(
        theta, [512.0], [512.0], chip=1
    )
    assert np.hypot(*gap[0]) == pytest.approx(SIZE[1] + 50, rel=0.02)


def _as_true(run, truth):
    """The solution, moved along free directions to where the truth has what the gauge holds."""
    theta, null, held = (
        run.parts["solved"].mode.theta,
        run.parts["solved"].gauge.null,
        run.parts["solved"].gauge.held,
    )
    first = theta - null @ np.linalg.solve(null[held], (theta - truth.theta)[held])
    for _ in range(3):  # of a large rotation the moves are not linear
        first -= null @ np.linalg.solve(null[held], (first - truth.theta)[held])
    return first


def _log(truth, folder: Path, factors) -> dict[str, str]:
    Table({"exposure": truth.model.exposures, "epoch": EPOCHS, "vafactor": factors}).write(
        folder / "log.ecsv"
    )
    return {"exposures": "log.ecsv"}


def test_vafactor_is_applied(tmp_path):
    """Free scales of the exposures show VAFACTOR where it is not given, and nothing where it is."""
    truth = small(frames="shift_rotation_scale")
    factors = 1.0 + 1e-4 * np.sin(np.arange(8.0))
    factors /= factors[0]
    at = [truth.model.frame_slice(e).start + 2 for e in range(1, 8)]
    scaled = truth.theta.copy()
    scaled[at] = factors[1:] - 1.0
    lists = list_table(_again(truth, scaled))
    block = {"frames": "shift_rotation_scale"}
    scales = []
    for name in ("with", "without"):
        folder = tmp_path / name
        folder.mkdir()
        config = write_selfcal(folder / "input", lists, selfcal=block | {"exposures": "log.ecsv"})
        _log(truth, config.parent, factors if name == "with" else np.ones(8))
        run = fitted(folder / "run", config)
        sigma = np.sqrt(np.diag(run.parts["solved"].mode.cov))[at]
        scales.append((run.parts["solved"].mode.theta[at], sigma))
    (known, sigma), (unknown, _) = scales
    # the simulated sky is smaller on the detector where the frame's scale is larger: what the
    # frames have without VAFACTOR is VAFACTOR, and with it what is left is its square
    np.testing.assert_array_less(np.abs(unknown - (factors[1:] - 1)), 4.5 * sigma)
    np.testing.assert_array_less(np.abs(unknown - known - (factors[1:] - 1)), 2e-7)


def _again(truth, theta):
    """The same stars, errors and exposures with other frames."""
    d, model = truth.detections, truth.model
    x, y = d.x.copy(), d.y.copy()
    good = d.star >= 0
    for e in range(len(model.exposures)):
        rows = np.flatnonzero(good & (d.exposure == e))
        stars = truth.sky[d.star[rows]]
        now = pixels_of(model, theta, stars, e, model.chips[0])
        before = pixels_of(model, truth.theta, stars, e, model.chips[0])
        x[rows] += now[0] - before[0]
        y[rows] += now[1] - before[1]
    inside = (np.abs(x - 512.5) < 512) & (np.abs(y - 512.5) < 512)
    return replace(truth, detections=replace(d, x=x, y=y).select(inside))


def test_motions_of_stars_that_do_not_move(tmp_path):
    """Proper motions come out as zero, by their errors, but for a motion of the whole sky.

    That is free, and named: exposures may have drifted and turned with time.
    """
    truth = small()
    config = write_selfcal(
        tmp_path / "input",
        list_table(truth),
        selfcal={"exposures": "log.ecsv", "motion": "proper_motion", "min_detections": 4},
    )
    _log(truth, config.parent, np.ones(8))
    run = fitted(tmp_path / "run", config)
    stars = star_catalogue(run.parts["solved"].mode)
    assert stars.values.shape[1] == 4 and stars.epoch == pytest.approx(EPOCHS.mean())
    assert run.parts["solved"].gauge.relative == ("drift_u", "drift_v", "spin")
    assert not run.parts["solved"].gauge.unnamed
    assert "motions are relative" in " ".join(run.parts["solved"].gauge.sentences)
    assert "drift u, drift v, spin by convention" in run.gauge_words
    place, motion = (stars.values[:, k : k + 2] @ [1, 1j] for k in (0, 2))
    sigma = np.sqrt(np.einsum("naa->n", stars.own[:, 2:, 2:]) / 2)
    design = np.column_stack([np.ones(len(stars)), 1j * place]) / sigma[:, None]
    # drift and spin are real numbers: of a complex number both parts count
    whole = np.column_stack([design[:, 0], 1j * design[:, 0], design[:, 1]])
    real = np.concatenate([whole.real, whole.imag])
    value = np.concatenate([(motion / sigma).real, (motion / sigma).imag])
    pulls = value - real @ np.linalg.lstsq(real, value, rcond=None)[0]
    inside = np.mean(np.abs(pulls) < 2)
    # the distortion's errors come on top of the stars' own
    assert inside > 0.93 - 3 * np.sqrt(0.95 * 0.05 / len(pulls))
    assert "pm_u" in Table.read(_stars(run)).colnames


def test_motions_of_references_fix_those_of_the_whole_sky(tmp_path, capsys):
    """With them, motions are those of the reference frame, and 'check' lists what fixes each.

    Stars that do not move have motions of zero in that frame.
    """
    truth = small()
    config = write_selfcal(
        tmp_path / "input",
        list_table(truth),
        selfcal={"exposures": "log.ecsv", "motion": "proper_motion", "min_detections": 4}
        | {"unit": "mas"},
        gauge={"reference": {"catalog": "reference.ecsv", "tangent_point": [RA, DEC]}},
    )
    _log(truth, config.parent, np.ones(8))
    rng = np.random.default_rng(8)
    known = rng.choice(len(truth.sky), 200, replace=False)
    table = _on_the_sky(truth.sky[known] - truth.sky.mean(axis=0))
    error = 0.01  # mas / yr
    for name in ("pmra", "pmdec"):
        table[name] = rng.normal(0, error, len(table)) * u.mas / u.yr
        table[f"{name}_error"] = np.full(len(table), error) * u.mas / u.yr
    table["epoch"] = np.full(len(table), EPOCHS.mean())
    table.write(config.parent / "reference.ecsv")
    assert main(["check", str(config)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    rates = ("drift_u", "drift_v", "spin")
    listed = ("zero_point_u", "zero_point_v", "scale", "rotation")
    assert "7 directions are free, 0 of them held by convention" in told
    for name in (*listed, *(f"{rate} of the whole sky" for rate in rates)):
        assert f"{name}: fixed by reference stars" in told
    assert "motions are relative" not in told
    run = fitted(tmp_path / "run", config)
    gauge = run.part(SelfCalibrated).gauge
    assert tuple(motion.name for motion in gauge.motions) == rates and not gauge.relative
    assert "drift u, drift v, spin by reference stars" in run.gauge_words
    rows = {str(row["name"]): str(row["fixed_by"]) for row in run.part(SelfCalibrated).gauge_table}
    assert rows["spin"] == "reference stars"
    stars = star_catalogue(run.part(SelfCalibrated).mode)
    weight = 1 / stars.own[:, 2, 2]
    mean = np.average(stars.values[:, 2], weights=weight)
    # the mean of the stars' motions, by its error
    assert abs(mean) < 4 * np.hypot(weight.sum() ** -0.5, error / np.sqrt(200))


def test_parallaxes(tmp_path):
    """They come out as they are, by their errors, but for one that all stars have."""
    truth, rng = small(disturbed=0.0), np.random.default_rng(8)
    epochs = 2010.0 + np.array([0.0, 0.1, 0.3, 0.55, 0.8, 1.05, 1.3, 1.6])
    d, model = truth.detections, truth.model
    parallax = rng.uniform(0.0, 10.0, len(truth.sky))  # mas
    factors = parallax_factors(epochs, RA, DEC)
    shift = (parallax[d.star, None] * factors[d.exposure]) / SCALE_MAS
    turn = np.array([np.linalg.inv(model.frame(truth.theta, e)[0]) for e in range(8)])
    moved = np.einsum("nab,nb->na", turn[d.exposure], shift)
    lists = list_table(
        replace(truth, detections=replace(d, x=d.x + moved[:, 0], y=d.y + moved[:, 1]))
    )
    config = write_selfcal(
        tmp_path / "input",
        lists,
        selfcal={
            "exposures": "log.ecsv",
            "motion": "parallax",
            "min_detections": 5,
            "unit": "mas",
        },
        gauge={"reference": {"catalog": "reference.ecsv", "tangent_point": [RA, DEC]}},
    )
    Table({"exposure": model.exposures, "epoch": epochs}).write(config.parent / "log.ecsv")
    known = rng.choice(len(truth.sky), 200, replace=False)
    _on_the_sky(truth.sky[known] - truth.sky.mean(axis=0)).write(config.parent / "reference.ecsv")
    run = fitted(tmp_path / "run", config)
    assert "parallax" in run.parts["solved"].gauge.relative
    assert "parallax of the whole sky" in " ".join(run.parts["solved"].gauge.sentences)
    problem, stars = (
        run.parts["solved"].mode.problem,
        star_catalogue(run.parts["solved"].mode),
    )
    whose = d.star[problem.rows[problem.starts[:-1]]]
    sigma = np.sqrt(stars.own[:, 4, 4])
    off = stars.values[:, 4] - parallax[whose]
    off -= np.average(off, weights=sigma**-2.0)
    pulls = off / sigma
    assert np.median(sigma) < 2.0  # of parallaxes that scatter by 2.9 mas
    low, high = stats.chi2.ppf([1e-3, 1 - 1e-3], len(pulls) - 1)
    # the distortion's errors come on top of the stars' own
    assert low < (pulls**2).sum() < 1.15 * high
    table = star_table(run.parts["solved"].mode, stars)
    assert table["parallax"].unit == "mas" and table["pm_u"].unit == "mas / yr"


def test_parallaxes_need_a_place_on_the_sky(tmp_path):
    config = write_selfcal(tmp_path / "input", list_table(small()), selfcal={"motion": "parallax"})
    refused(tmp_path, "check", config, words=("selfcal.motion", "position of the field on the sky"))


def _on_the_sky(places: np.ndarray) -> Table:
    """Pixels along east and north of the field's centre as a catalogue."""
    plane = WCS(naxis=2)
    plane.wcs.ctype, plane.wcs.crval, plane.wcs.crpix = ["RA---TAN", "DEC--TAN"], [RA, DEC], [1, 1]
    ra, dec = plane.wcs_pix2world(places * SCALE_MAS / 3.6e6, 0).T
    error = np.full(len(ra), 0.5)
    columns = {"ra": ra, "dec": dec, "ra_error": error, "dec_error": error}
    return Table(columns, units={"ra": "deg", "dec": "deg", "ra_error": "mas", "dec_error": "mas"})


def _stars(run) -> Path:
    path = run.directory / "stars.ecsv"
    write_table(
        star_table(run.parts["solved"].mode, star_catalogue(run.parts["solved"].mode)),
        path,
    )
    return path


def test_a_start_from_an_earlier_run(three_rolls, tmp_path):
    """A run that begins with the solution of another one finds the same."""
    config = write_selfcal(
        tmp_path / "input",
        list_table(three_rolls.truth),
        selfcal={"initial_distortion": str(three_rolls.path), "start_radius": 0.5},
    )
    run = fitted(tmp_path / "run", config)
    before = load_fit(three_rolls.path / "fit.nc")
    # frames turn about another point: the polynomials are to be compared
    free = np.flatnonzero(before.sigma[: before.model.n_polynomial] > 0)
    # held coefficients are those of the start here, and of no distortion there
    moved = (
        run.parts["solved"].gauge.null
        @ np.linalg.lstsq(
            run.parts["solved"].gauge.null[run.parts["solved"].gauge.held],
            (before.mean - run.fit.mean)[run.parts["solved"].gauge.held],
            rcond=None,
        )[0]
    )
    off = np.abs(run.fit.mean + moved - before.mean)
    assert (off[free] < 0.2 * before.sigma[free]).all()
