"""An earlier calibration as the prior of the next one."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

import bayesdist as bd
from bayesdist.app.config import load_config
from bayesdist.app.config.fit import PriorCalibrationBlock
from bayesdist.app.store import Record
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.calibration.calibration import calibration_of
from bayesdist.calibration.prior import prior_of_calibration
from bayesdist.errors import InputError
from bayesdist.infer import save_fit
from bayesdist.infer.solution.linear import NO_REJECTION
from bayesdist.kinds.matches.kind import earlier_calibration
from tests.app.support import as_table, good, refused
from tests.reduced import case_in_full, only_in_full

SIZE = (1000.0, 800.0)
CHIP = bd.Chip(1, "chip 1", SIZE, (500.5, 400.5))
SIGMA = 0.01
CHANGE = 0.05


def model_of(order=3, unit="pix", **what):
    return bd.DistortionModel(order, (CHIP,), unit, **what)


def truth_of(model, rng, turn=1.0 + 0j, shift=0j):
    """Random distortion of some pixels on a plane that is turned and shifted."""
    theta = np.zeros(model.n_params)
    u, v = (model.coefficient_slice(1, axis) for axis in (0, 1))
    k = model.n_terms
    w = rng.normal(size=k) + 1j * rng.normal(size=k)
    w[:3] = 0.0, SIZE[0] / 2, 1j * SIZE[1] / 2
    w *= turn
    w[0] += shift
    theta[u], theta[v] = w.real, w.imag
    return theta


def turned(theta, model, turn, shift=0j):
    """The same distortion on a plane that is turned and shifted."""
    u, v = (model.coefficient_slice(1, axis) for axis in (0, 1))
    w = turn * (theta[u] + 1j * theta[v])
    w[0] += shift
    out = theta.copy()
    out[u], out[v] = w.real, w.imag
    return out


def stars_of(model, theta, n, rng):
    return bd.simulate_matches(model, theta, n, sigma=SIGMA, fraction=0.0, rng=rng)[0]


def both(a, b):
    """Two tables as one."""
    names = ("x", "y", "u", "v", "sigma_u", "sigma_v")
    columns = {name: np.concatenate([a.column(name), b.column(name)]) for name in names}
    return bd.Matches(**columns, unit=a.unit)


def fitted(stars, model, priors=None):
    return bd.fit_linear(stars, model, rejection=NO_REJECTION, priors=priors)


def earlier(solution, model, **what):
    return prior_of_calibration(calibration_of(solution, "earlier"), model, **what)


def test_it_is_the_joint_fit_of_both_data_sets():
    """In the Gaussian case the posterior of the second is that of all stars together."""
    rng, model = np.random.default_rng(1), model_of()
    theta = truth_of(model, rng)
    first, second = stars_of(model, theta, 300, rng), stars_of(model, theta, 12, rng)
    prior = earlier(fitted(first, model), model)
    one = fitted(second, model, prior.loose())
    whole = fitted(both(first, second), model)
    np.testing.assert_allclose(one.mean, whole.mean, atol=1e-8 * whole.sigma.max())
    np.testing.assert_allclose(one.cov, whole.cov, rtol=1e-6, atol=1e-9 * whole.cov.max())


def test_the_posterior_is_that_of_all_stars():
    """Sampled, with errors that are known: mean and covariance of the joint fit."""
    rng, model = np.random.default_rng(2), model_of(2)
    theta = truth_of(model, rng)
    first, second = stars_of(model, theta, 100, rng), stars_of(model, theta, 20, rng)
    priors = earlier(fitted(first, model), model).loose()
    mixture = bd.OutlierMixture(model="none", jitter=0.0)
    sampled = bd.sample(
        fitted(second, model, priors), second, outliers=mixture, priors=priors, seed=3
    )
    whole = fitted(both(first, second), model)
    n = sampled.convergence.ess_bulk_min
    assert np.abs((sampled.mean - whole.mean) / whole.sigma).max() < 4.5 / np.sqrt(n)
    ratio = np.diag(sampled.cov) / np.diag(whole.cov)
    assert np.abs(ratio - 1).max() < 4.5 * np.sqrt(2 / n)


def test_intervals_cover_as_they_say(full):
    """Truths with a first calibration and a sparse second one, shifted and turned: 68 and 95 %."""
    rng, model = np.random.default_rng(3), model_of(3)
    held = model_of(4)
    x, y = rng.uniform(1, 1000, 50), rng.uniform(1, 800, 50)
    pulls, wider, changed = [], [], []
    for _ in range(150 if full else 30):
        theta = truth_of(model, rng)
        turn, shift = np.exp(1j * rng.uniform(0, 2 * np.pi)), complex(*rng.normal(size=2))
        first = stars_of(model, theta, 200, rng)
        second = stars_of(model, turned(theta, model, turn, shift), 10, rng)
        prior = earlier(fitted(first, model), model, frame="shift_rotation")
        loose = fitted(second, model, prior.loose())
        found = fitted(second, model, prior.about(loose.mean))
        off = found.mean - turned(theta, model, turn, shift)
        pulls.append(_pulls(model, off, found.cov, x, y))
        # a higher order, of which the earlier one says nothing
        prior = earlier(fitted(first, model), held, frame="shift")
        more = stars_of(model, turned(theta, model, 1.0, shift), 40, rng)
        found = fitted(more, held, prior.loose())
        off = found.mean - _padded(turned(theta, model, 1.0, shift), model, held)
        wider.append(_pulls(held, off, found.cov, x, y))
        # another filter, whose distortion has changed by as much as is said
        prior = earlier(fitted(first, model), model, change_pix=CHANGE)
        other = theta + CHANGE * _even(model) * rng.normal(size=model.n_params)
        found = fitted(stars_of(model, other, 10, rng), model, prior.loose())
        changed.append(_pulls(model, found.mean - other, found.cov, x, y))
    for pull in (pulls, wider, changed):
        # mean over positions of one truth: these are independent of each other
        for level, sigmas in ((0.6827, 1.0), (0.9545, 2.0)):
            covered, error = _coverage(pull, sigmas)
            assert abs(covered - level) < 4 * error


@pytest.mark.slow
@only_in_full("intervals with many draws cover")
@pytest.mark.parametrize("n_stars", [case_in_full(10, instead="as many as before are run"), 200])
def test_a_prior_of_few_draws_covers_at_least_as_it_says(n_stars, full):
    """Mean and covariance of four draws a parameter, the fewest that are taken: 68 and 95 %.

    Few stars after it get errors that are too large, by no more than the factor of Hartlap on the
    inverse covariance; as many as before get right ones.  Without the factor these were too small.
    """
    rng, model = np.random.default_rng(4), model_of(3)
    x, y = rng.uniform(1, 1000, 50), rng.uniform(1, 800, 50)
    n = model.n_params
    pulls, plain, wider = [], [], []
    for _ in range(400 if full else 80):
        theta = truth_of(model, rng)
        second = stars_of(model, theta, n_stars, rng)
        exact = earlier(fitted(stars_of(model, theta, 200, rng), model), model, frame="none")
        draws = rng.multivariate_normal(exact.mean, exact.cov, 4 * n)
        few = replace(exact, mean=draws.mean(axis=0), cov=np.cov(draws.T), draws=4.0 * n)
        found = fitted(second, model, few.about(theta))
        pulls.append(_pulls(model, found.mean - theta, found.cov, x, y))
        raw = fitted(second, model, replace(few, draws=np.inf).about(theta))
        plain.append(_pulls(model, raw.mean - theta, raw.cov, x, y))
        known = fitted(second, model, exact.about(theta))
        wider.append(np.trace(np.linalg.solve(known.cov, found.cov)) / n)
    for level, sigmas in ((0.6827, 1.0), (0.9545, 2.0)):
        covered, error = _coverage(pulls, sigmas)
        assert covered > level - 4 * error
        if n_stars == 200:
            assert covered < level + 4 * error
            covered, error = _coverage(plain, sigmas)
            assert covered < level - 2 * error
    assert 1.0 < np.mean(wider) < (4 * n - 1) / (4 * n - n - 2)


def _coverage(pulls, sigmas):
    """Fraction of positions within so many sigma, and its error from truth to truth."""
    covered = (np.abs(pulls) < sigmas).mean(axis=1)
    return covered.mean(), covered.std(ddof=1) / np.sqrt(len(covered))


def _even(model):
    """Standard deviations of coefficients that have one rms each, and together one on each axis."""
    return np.tile(1 / np.sqrt(model.n_terms * model.basis().mean_squares), 2)


def _pulls(model, off, cov, x, y):
    """Errors of u and v over their standard deviations at some pixels."""
    phi = model.basis().evaluate(x, y)
    design = np.kron(np.eye(2), phi)
    return design @ off / np.sqrt(np.einsum("nk,kl,nl->n", design, cov, design))


def _padded(theta, model, higher):
    """Parameters of a model of higher order with the same polynomials."""
    out = np.zeros(higher.n_params)
    for axis in (0, 1):
        start = higher.coefficient_slice(1, axis).start
        part = theta[model.coefficient_slice(1, axis)]
        out[start : start + len(part)] = part
    return out


def test_a_few_stars_in_a_corner_are_enough():
    """The earlier calibration has the rest; shift and rotation alone are of the new stars."""
    rng, model = np.random.default_rng(4), model_of(3)
    theta = truth_of(model, rng)
    solution = fitted(stars_of(model, theta, 400, rng), model)
    turn = np.exp(0.8j)
    here = turned(theta, model, turn)
    x, y = rng.uniform(1, 200, 30), rng.uniform(1, 200, 30)
    phi = model.basis().evaluate(x, y)
    u, v = (phi @ here[model.coefficient_slice(1, a)] for a in (0, 1))
    u, v = u + SIGMA * rng.normal(size=30), v + SIGMA * rng.normal(size=30)
    error = np.full(30, SIGMA)
    stars = bd.Matches(x=x, y=y, u=u, v=v, sigma_u=error, sigma_v=error, unit="pix")
    prior = earlier(solution, model, frame="shift_rotation")
    first = fitted(stars, model, prior.loose())
    found = fitted(stars, model, prior.about(first.mean))
    at = np.array([[900.0], [700.0]])
    pull = _pulls(model, found.mean - here, found.cov, *at)
    assert np.abs(pull).max() < 4
    phi = model.basis().evaluate(*at)[0]
    # a turn by 30 stars in a fifth of the detector, at four times that distance
    assert phi @ found.cov[:10, :10] @ phi < 0.05**2
    with pytest.raises(bd.BayesdistError, match="extrapolated"):
        fitted(stars, model)


def test_a_frame_takes_what_it_is_free_to_take():
    """Along its frame the prior is flat, and nowhere else."""
    rng, model = np.random.default_rng(5), model_of(2)
    solution = fitted(stars_of(model, truth_of(model, rng), 200, rng), model)
    kinds = ("none", "shift", "shift_rotation", "shift_rotation_scale", "affine")
    for frame, free in zip(kinds, (0, 2, 3, 4, 6), strict=True):
        joint = earlier(solution, model, frame=frame).about(solution.mean).joint
        values = np.linalg.eigvalsh(joint.precision * np.outer(solution.sigma, solution.sigma))
        assert joint.rank == model.n_params - free
        assert (values < 1e-8 * values[-1]).sum() == free
        moved = turned(solution.mean, model, 1.0, 3.0 - 2.0j)
        pulled = joint.precision @ (moved - solution.mean) * solution.sigma
        assert (np.abs(pulled).max() < 1e-6) == (free > 0)


def test_a_change_is_as_large_as_it_is_said():
    """change_pix is the rms over the detector, on each axis, of what is added."""
    rng, model = np.random.default_rng(6), model_of(3)
    solution = fitted(stars_of(model, truth_of(model, rng), 200, rng), model)
    plain, wide = (earlier(solution, model, change_pix=c) for c in (0.0, 0.2))
    added = np.diag(wide.cov - plain.cov).reshape(2, -1)
    rms = np.sqrt((added * model.basis().mean_squares).sum(axis=1))
    pixel = calibration_of(solution).pixel()[0]
    np.testing.assert_allclose(rms, 0.2 * pixel)


def test_units_are_converted():
    rng, model = np.random.default_rng(7), model_of(2, "arcsec")
    solution = fitted(stars_of(model, truth_of(model, rng), 100, rng), model)
    found = earlier(solution, model_of(2, "mas"))
    np.testing.assert_allclose(found.mean, 1000 * solution.mean)
    np.testing.assert_allclose(found.cov, 1e6 * solution.cov)


def test_what_does_not_go_together_is_refused():
    rng, model = np.random.default_rng(8), model_of(2)
    solution = fitted(stars_of(model, truth_of(model, rng), 100, rng), model)
    calibration = calibration_of(solution, "earlier")
    other = bd.DistortionModel(2, (replace(CHIP, size=(900.0, 800.0)),), "pix")
    wrong = {
        "needs a covariance": (replace(calibration, errors="sigma"), model),
        "order 2, but the model is of order 1": (calibration, model_of(1)),
        "chip 1 of 1000 x 800": (calibration, other),
        "stars are in arcsec": (calibration, model_of(2, "arcsec")),
        "does not have the same drift": (
            calibration,
            model_of(2, time=bd.TimeDependence((("u", 1, 0),), (2010.0,))),
        ),
    }
    for message, (one, of) in wrong.items():
        with pytest.raises(InputError, match=message):
            prior_of_calibration(one, of)
    few = replace(prior_of_calibration(calibration, model), draws=30.0)
    with pytest.raises(InputError, match="30 effective draws"):
        few.loose()


CONFIG = """
[detector]
name = "chip 1"
size = [1000, 800]
[data]
matches = "second.ecsv"
[model]
order = 3
[sampler]
target_ess = 100
[prior_calibration]
source = "fit.nc"
frame = "shift"
"""


def test_a_run_goes_by_it(tmp_path):
    """The fit of a configuration, saved and loaded, and the inputs that are recorded."""
    from bayesdist.app.config import parse_config
    from bayesdist.app.parts import read_stored_fit, write_stored_fit
    from bayesdist.app.pipeline import fit, match
    from bayesdist.app.run import Run
    from bayesdist.app.stages import FIT_ARTEFACTS
    from bayesdist.app.store.made_from import hashes_of

    rng, model = np.random.default_rng(9), model_of(3)
    theta = truth_of(model, rng)
    solution = fitted(stars_of(model, theta, 300, rng), model)
    save_fit(solution, tmp_path / "fit.nc")
    second = stars_of(model, theta, 12, rng)
    as_table(second).write(tmp_path / "second.ecsv")
    config = parse_config(CONFIG, "second.toml")
    assert "fit.nc" in hashes_of(config, tmp_path)
    run = Run.of(RunDirectory.unsaved(config, CONFIG, files=True, base=tmp_path))
    found = fit(match(run))
    expected = fitted(second, model, earlier(solution, model, frame="shift").loose())
    np.testing.assert_allclose(found.fit.mean, expected.mean, atol=1e-9)
    write_stored_fit(tmp_path, **{name: getattr(found, name) for name in FIT_ARTEFACTS})
    again = read_stored_fit(tmp_path)
    np.testing.assert_array_equal(again["priors"].joint.precision, found.priors.joint.precision)


@pytest.mark.parametrize("stage", ["fit", "sample", "diagnose"])
def test_a_run_that_is_damaged_is_no_prior(finished, tmp_path, stage):
    """Without the errors that were found in it, it would claim too much."""
    run = RunDirectory(shutil.copytree(finished.path, tmp_path / "run"))
    model = bd.load_posterior(run.path).model
    block = PriorCalibrationBlock(source="run", frame="none")
    config = load_config(finished.config)[0].model_copy(update={"prior_calibration": block})
    assert earlier_calibration(model, config, tmp_path) is not None
    name = next(iter(run.record.artefacts[stage].files))
    (run / name).unlink()
    with pytest.raises(InputError, match=f"{name}: is gone"):
        earlier_calibration(model, config, tmp_path)


def never_diagnosed(finished, folder):
    """A copy of a run that ended before its residuals were looked at."""
    path = shutil.copytree(finished.path, folder)
    record = Record.read(path / "run.json")
    for stage in ("diagnose", "evaluate", "export", "report"):
        del record.artefacts[stage]
    record.write(path / "run.json")
    return path


def test_a_run_that_was_never_diagnosed_is_no_prior(finished, tmp_path):
    run = never_diagnosed(finished, tmp_path / "run")
    block = PriorCalibrationBlock(source="run", frame="none")
    config = load_config(finished.config)[0].model_copy(update={"prior_calibration": block})
    with pytest.raises(InputError, match="needs stage 'diagnose', which has not been run"):
        earlier_calibration(bd.load_posterior(run).model, config, tmp_path)


def test_nor_is_it_a_calibration_for_commands(finished, tmp_path):
    """Without its record it is a bare posterior, whose errors are its own alone."""
    run = never_diagnosed(finished, tmp_path / "run")
    (tmp_path / "stars.csv").write_text("x,y\n500,400\n600,500\n")
    out = tmp_path / "out.csv"
    apply = ("apply", run, tmp_path / "stars.csv", "-o", out)
    words = ("needs stage 'diagnose', which has not been run", f"bayesdist stage diagnose {run}")
    refused(tmp_path, *apply, words=words)
    refused(tmp_path, "compare", run, finished.path, words=words)
    refused(tmp_path, "monitor", run, tmp_path / "stars.csv", words=words)
    good("apply", shutil.copy(run / "posterior.nc", tmp_path), *apply[2:])
    assert "sigma_x_out" in out.read_text()
