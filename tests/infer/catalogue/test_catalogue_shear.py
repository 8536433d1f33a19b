"""A sheared catalogue: at which roll angles its shear is told from the detector's."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer import GaussianPriors, fit_linear
from bayesdist.infer.catalogue.catalogue_shear import catalogue_shear, one_roll_angle, roll_spread

from ..small_campaign import campaign

pytestmark = pytest.mark.usefixtures("one_thread")

SHEAR = np.array([3e-5, -2e-5])
FRAMES = {"time": False, "tau": (0.0, 0.0, 0.0), "frames": "shift_rotation"}


def sheared(seed, rolls, *, shear=SHEAR, per_exposure=200, **options):
    """Matches to a catalogue that is sheared; the reference positions are wrong, not the pixels."""
    options = FRAMES | options
    model, matches, theta = campaign(seed, len(rolls), per_exposure, rolls=rolls, **options)
    plus, cross = shear
    u = matches.u + plus * matches.u + cross * matches.v
    v = matches.v - plus * matches.v + cross * matches.u
    return model, matches._with(u=u, v=v), theta


ONE = {
    "one": [0.7, 0.7, 0.7, 0.7],
    "half a turn apart": [0.7, 0.7 + np.pi, 0.7, 0.7 - np.pi],
}


@pytest.mark.parametrize("rolls", ONE.values(), ids=ONE)
def test_at_one_roll_angle_it_is_a_shear_of_the_detector(rolls):
    """Exactly degenerate, by the names of the linear terms; the fit itself notices nothing."""
    model, matches, _ = sheared(1, rolls)
    fit = fit_linear(matches, model)
    assert abs(fit.chi2 / fit.dof - 1) < 5 * np.sqrt(2 / fit.dof)
    with pytest.raises(DegenerateError, match="one roll angle, or angles half a turn apart") as e:
        catalogue_shear(fit, matches)
    message = str(e.value)
    assert "catalogue.shear_plus" in message or "catalogue.shear_cross" in message
    parts = set(re.findall(r"WFC\d\.[uv]_\d_\d", message))
    assert parts and parts <= {
        f"WFC{c}.{a}_{i}_{j}" for c in (1, 2) for a in "uv" for i, j in ((1, 0), (0, 1), (0, 0))
    }
    # the detector takes it all: at this roll its own shear is that of the catalogue, turned
    good, plain, _ = sheared(1, rolls, shear=(0.0, 0.0))
    change = fit.mean - fit_linear(plain, good).mean
    turned = np.exp(-2j * 0.7) * complex(*SHEAR)
    u10 = change[model.names.index("WFC2.u_1_0")] / 2048
    v01 = change[model.names.index("WFC2.v_0_1")] / 1024
    assert (u10 - v01) / 2 == pytest.approx(turned.real, abs=3e-6)


@pytest.mark.parametrize(
    "rolls", [[0.2, 0.2 + np.pi / 2, 0.2, 0.2 - np.pi / 2], [0.0, 1.0, 2.5, -2.0]]
)
def test_at_other_angles_it_is_found(rolls):
    model, matches, _ = sheared(2, rolls)
    found = catalogue_shear(fit_linear(matches, model), matches)
    d = found.value - SHEAR
    assert stats.chi2(2).sf(d @ np.linalg.solve(found.cov, d)) > 1e-3
    assert (found.sigma < 3e-6).all()
    assert found.roll_spread == pytest.approx(
        1 - abs(np.exp(2j * np.array(rolls)).mean()), abs=1e-4
    )


def test_its_error_is_that_of_a_dense_fit():
    """All columns side by side, and the error grows as the angles close up."""
    sigma = []
    for apart in (np.pi / 2, 0.2, 0.02):
        model, matches, _ = sheared(3, [0.5, 0.5 + apart], per_exposure=100)
        fit = fit_linear(matches, model, clip_chi2=1e9, clip_abs=None)
        found = catalogue_shear(fit, matches)
        where = {"exposure": matches.exposure, "chip": matches.chip_number}
        J = model.jacobian(fit.mean, matches.x, matches.y, **where)
        u, v = model.predict(fit.mean, matches.x, matches.y, **where).T
        shears = np.stack([np.column_stack([u, -v]), np.column_stack([v, u])], axis=2)
        A = np.concatenate([J, shears], axis=2).reshape(-1, model.n_params + 2) / 0.02
        r = np.column_stack([matches.u - u, matches.v - v]).ravel() / 0.02
        size = np.sqrt((A**2).sum(axis=0))
        step, cov = (
            np.linalg.lstsq(A / size, r)[0] / size,
            np.linalg.pinv((A / size).T @ (A / size)),
        )
        expected = np.sqrt(np.diag(cov)[-2:]) / size[-2:]
        np.testing.assert_allclose(found.sigma, expected, rtol=1e-3)
        np.testing.assert_allclose((found.value - step[-2:]) / expected, 0, atol=1e-3)
        sigma.append(found.sigma.max())
    # by the sine of twice the angle between them
    assert sigma[2] / sigma[1] == pytest.approx(10, rel=0.15)


def test_without_a_shear_none_is_found():
    pulls = []
    for seed in range(8):
        model, matches, _ = sheared(20 + seed, [0.0, 1.2, 2.2, -1.5], shear=(0.0, 0.0), order=2)
        found = catalogue_shear(fit_linear(matches, model), matches)
        pulls.append(found.value @ np.linalg.solve(found.cov, found.value))
    assert stats.kstest(pulls, stats.chi2(2).cdf).pvalue > 1e-3


def test_frames_that_shear_absorb_it_unless_they_have_priors():
    rolls = [0.0, 1.2, 2.2, -1.5]
    model, matches, _ = sheared(4, rolls, frames="affine", tau=(3e-6, 3e-6, 3e-6))
    first = replace(model, gauge="first", held=(0.0, 0.0, 0.0))
    with pytest.raises(DegenerateError, match=r"j00\d\.shear.*frame 'affine'.*absorbs any shear"):
        catalogue_shear(fit_linear(matches, first), matches)
    priors = GaussianPriors.of(
        model,
        {n: (0.0, 3e-6) for n in model.names if n.endswith(("scale", "shear_plus", "shear_cross"))},
    )
    found = catalogue_shear(fit_linear(matches, model, priors=priors), matches, priors=priors)
    d = found.value - SHEAR
    assert stats.chi2(2).sf(d @ np.linalg.solve(found.cov, d)) > 1e-3


def test_frames_without_a_roll_angle_are_refused():
    model, matches, _ = sheared(5, [0.0, 0.0, 0.0], frames="shift")
    with pytest.raises(InputError, match="frames 'shift' hold no roll angle"):
        catalogue_shear(fit_linear(matches, model), matches)


def test_how_far_roll_angles_differ():
    assert roll_spread([0.3, 0.3 + np.pi, 0.3 - np.pi]) == pytest.approx(0.0, abs=1e-12)
    assert roll_spread([0.3, 0.3 + np.pi / 2]) == pytest.approx(1.0)
    assert roll_spread(np.linspace(0, np.pi, 7)[:-1]) == pytest.approx(1.0)
    few = np.radians(np.random.default_rng(1).normal(0, 2.0, 4000))
    assert roll_spread(few) == pytest.approx(2 * few.var(), rel=0.02)
    assert one_roll_angle(0.5 * few) and not one_roll_angle(2 * few)
    assert one_roll_angle([1.0]) and not one_roll_angle(np.radians([0.0, 10.0]))
