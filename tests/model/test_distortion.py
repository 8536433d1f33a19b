"""The model against the formula written out star by star, and its derivatives by differences."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.linalg import polar

from bayesdist.errors import InputError
from bayesdist.model import FRAME_KINDS, Chip, DistortionModel, TimeDependence

CHIPS = (
    Chip(2, "WFC2", (400.0, 200.0), (200.0, 100.0)),
    Chip(1, "WFC1", (380.0, 220.0), (190.0, 115.0)),
)
TIME = TimeDependence((("u", 1, 0), ("v", 1, 0), ("v", 0, 2)), (2004.5, 2012.5), (2009.4,))
EXPOSURES = ("a", "b", "c")


def model_of(frames: str, *, order: int = 3, **changes) -> DistortionModel:
    options = {
        "order": order,
        "chips": CHIPS,
        "unit": "mas",
        "time": TIME,
        "frames": frames,
        "exposures": EXPOSURES,
        "origin": (30.0, -20.0),
    } | changes
    return DistortionModel(**options)


def some_theta(model: DistortionModel, seed: int = 1) -> np.ndarray:
    theta = np.random.default_rng(seed).standard_normal(model.n_params)
    theta[: model.n_polynomial] *= 50
    theta[model.n_global :] *= 0.3
    return theta


def some_stars(n: int = 60, seed: int = 2) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "x": rng.uniform(1, 380, n),
        "y": rng.uniform(1, 200, n),
        "epoch": rng.choice([2003.2, 2009.4, 2013.7], n),
        "exposure": rng.integers(3, size=n),
        "chip": rng.choice([1, 2], n),
    }


def named(model: DistortionModel, theta: np.ndarray) -> dict[str, float]:
    return dict(zip(model.names, theta, strict=True))


def before_frames(model: DistortionModel, theta, x, y, epoch, chip) -> np.ndarray:
    """w of one star, from the documented meaning of the parameters' *names*."""
    value = named(model, theta)
    c = next(c for c in model.chips if c.number == chip)
    prefix = f"{c.name}." if len(model.chips) > 1 else ""
    (nx, ny), (xref, yref) = c.size, c.reference_pixel
    X, Y = (x - (nx + 1) / 2) / (nx / 2), (y - (ny + 1) / 2) / (ny / 2)
    w = np.zeros(2)
    for a, axis in enumerate("uv"):
        for i in range(model.order + 1):
            for j in range(model.order + 1 - i):
                P = legendre.legval(X, np.eye(i + 1)[i]) * legendre.legval(Y, np.eye(j + 1)[j])
                w[a] += value[f"{prefix}{axis}_{i}_{j}"] * P
    if model.time is not None:
        for axis, i, j in model.time.terms:
            name = f"{prefix}tdd.{axis}_{i}_{j}"
            if epoch < 2009.4:
                coefficient = value[f"{name}.rate"] * (epoch - 2004.5)
            else:
                coefficient = value[f"{name}.step_2"] + value[f"{name}.rate_2"] * (epoch - 2012.5)
            monomial = ((x - xref) / (nx / 2)) ** i * ((y - yref) / (ny / 2)) ** j
            w["uv".index(axis)] += coefficient * monomial
    return w


def formula(model: DistortionModel, theta, x, y, epoch, exposure, chip) -> np.ndarray:
    """(u, v) of one star, from the documented meaning of the parameters' *names*."""
    value = named(model, theta)
    w = before_frames(model, theta, x, y, epoch, chip)
    if model.frames == "none" or exposure is None:
        return w
    if exposure == 0 and model.gauge == "first":
        return w
    e = model.exposures[exposure]
    if exposure == 0:
        value |= {
            f"{e}.{p}": held
            for p, held in zip(("shift_u", "shift_v", "rotation"), model.held, strict=True)
        }
    p = {
        name: value.get(f"{e}.{name}", 0.0)
        for name in ("shift_u", "shift_v", "rotation", "scale", "shear_plus", "shear_cross")
    }
    c = next(c for c in model.chips if c.number == chip)
    own = {
        name: value.get(f"{e}.{c.name}.{name}", 0.0)
        for name in ("shift_u", "shift_v", "rotation", "scale", "shear_plus", "shear_cross")
    }
    centre = before_frames(model, theta, *c.reference_pixel, epoch, chip)
    du, dv = w - centre
    w[0] += own["shift_u"] + (own["scale"] + own["shear_plus"]) * du
    w[0] += (own["shear_cross"] - own["rotation"]) * dv
    w[1] += own["shift_v"] + (own["scale"] - own["shear_plus"]) * dv
    w[1] += (own["shear_cross"] + own["rotation"]) * du
    o = model.origin
    # the detector deviates, then the telescope rolls, then it points elsewhere
    du, dv = w - (centre if model.chip_deviations and c != model.chips[0] else o)
    su = w[0] - o[0] + (p["scale"] + p["shear_plus"]) * du + p["shear_cross"] * dv
    sv = w[1] - o[1] + (p["scale"] - p["shear_plus"]) * dv + p["shear_cross"] * du
    c, s = np.cos(p["rotation"]), np.sin(p["rotation"])
    return np.array([o[0] + p["shift_u"] + c * su - s * sv, o[1] + p["shift_v"] + s * su + c * sv])


HELD = {"gauge": "held", "held": (4.0, -3.0, 0.6)}
HELD_APART = HELD | {"chip_deviations": True}
GAUGES = [(frames, {}) for frames in FRAME_KINDS] + [
    (frames, HELD) for frames in ("shift_rotation", "shift_rotation_scale", "affine")
]
GAUGES += [("shift_rotation", HELD_APART), ("affine", HELD_APART)]
in_every_gauge = pytest.mark.parametrize(
    ("frames", "gauge"), GAUGES, ids=[f"{f}-{'-'.join(g) or 'first'}" for f, g in GAUGES]
)


@in_every_gauge
def test_predict_is_the_formula(frames, gauge):
    model = model_of(frames, **gauge)
    theta, stars = some_theta(model), some_stars()
    expected = [
        formula(model, theta, *(stars[k][n] for k in ("x", "y", "epoch", "exposure", "chip")))
        for n in range(len(stars["x"]))
    ]
    np.testing.assert_allclose(model.predict(theta, **stars), expected, rtol=1e-12, atol=1e-10)


def test_predict_of_one_chip_without_anything_else():
    model = DistortionModel(5, CHIPS[:1])
    theta, stars = some_theta(model), some_stars()
    X, Y = (stars["x"] - 200.5) / 200, (stars["y"] - 100.5) / 100
    for axis in (0, 1):
        grid = np.zeros((6, 6))
        for (i, j), c in zip(
            model.basis().terms, theta[model.coefficient_slice(None, axis)], strict=True
        ):
            grid[i, j] = c
        np.testing.assert_allclose(
            model.predict(theta, stars["x"], stars["y"])[:, axis],
            legendre.legval2d(X, Y, grid),
            atol=1e-10,
        )


def test_predict_of_many_thetas_is_that_of_each():
    model = model_of("affine")
    stars = some_stars()
    thetas = np.array([[some_theta(model, s) for s in (1, 2, 3)], [some_theta(model, 4)] * 3])
    out = model.predict(thetas, **stars)
    assert out.shape == (2, 3, 60, 2)
    for k in np.ndindex(2, 3):
        np.testing.assert_allclose(out[k], model.predict(thetas[k], **stars), rtol=1e-12)


def test_one_value_serves_all_stars_and_names_serve_as_codes():
    model = model_of("shift_rotation")
    theta, stars = some_theta(model), some_stars()
    x, y, n = stars["x"], stars["y"], len(stars["x"])
    one = model.predict(theta, x, y, epoch=2003.0, exposure="c", chip=1)
    every = model.predict(
        theta, x, y, epoch=np.full(n, 2003.0), exposure=np.full(n, 2), chip=np.ones(n, int)
    )
    np.testing.assert_array_equal(one, every)
    names = np.array(EXPOSURES)[stars["exposure"]]
    np.testing.assert_array_equal(
        model.predict(theta, **stars | {"exposure": names}), model.predict(theta, **stars)
    )


def test_no_exposure_means_the_gauge_frame():
    model = model_of("affine")
    theta, stars = some_theta(model), some_stars()
    without = {k: v for k, v in stars.items() if k != "exposure"}
    np.testing.assert_array_equal(
        model.predict(theta, **without), model.predict(theta, **without, exposure=0)
    )
    other = theta.copy()
    other[model.n_global :] += 1.0  # frames of the others do not matter
    np.testing.assert_array_equal(model.predict(other, **without), model.predict(theta, **without))


def test_inputs_are_not_changed():
    model = model_of("affine")
    theta, stars = some_theta(model), some_stars()
    before = theta.copy(), {k: v.copy() for k, v in stars.items()}
    model.predict(theta, **stars)
    model.jacobian(theta, **stars)
    np.testing.assert_array_equal(theta, before[0])
    for k, v in stars.items():
        np.testing.assert_array_equal(v, before[1][k])


@in_every_gauge
def test_effective_coefficients_are_the_whole_model(frames, gauge):
    model = model_of(frames, **gauge)
    theta, stars = some_theta(model), some_stars()
    groups = model.groups(60, **{k: stars[k] for k in ("epoch", "exposure", "chip")})
    E = model.effective(theta, groups)
    out = np.empty((60, 2))
    for n, g in enumerate(groups.index):
        number = model.chips[groups.chip[g]].number
        assert number == stars["chip"][n]
        phi = model.basis(number).evaluate(stars["x"][n : n + 1], stars["y"][n : n + 1])[0]
        out[n] = E[g] @ phi
    np.testing.assert_allclose(out, model.predict(theta, **stars), rtol=1e-12)


@in_every_gauge
def test_jacobian_by_differences(frames, gauge):
    model = model_of(frames, **gauge)
    theta, stars = some_theta(model), some_stars(25)
    J = model.jacobian(theta, **stars)
    assert J.shape == (25, 2, model.n_params)
    step = 1e-3
    sides = theta + step * np.concatenate([np.eye(model.n_params), -np.eye(model.n_params)])
    plus, minus = np.split(model.predict(sides, **stars), 2)
    # a cosine's third derivative times step^2 / 6 times 100 mas is below 2e-5
    np.testing.assert_allclose(np.moveaxis((plus - minus) / (2 * step), 0, -1), J, atol=3e-5)


@in_every_gauge
def test_slopes_by_differences(frames, gauge):
    model = model_of(frames, **gauge)
    theta, stars = some_theta(model), some_stars(25)
    slopes = model.slopes(theta, **stars)
    for axis, name in enumerate("xy"):
        sides = [model.predict(theta, **stars | {name: stars[name] + d}) for d in (1.0, -1.0)]
        # of a cubic, exact but for the third derivative / 6: 5 a^3 of its term, a = 2 / 200
        np.testing.assert_allclose((sides[0] - sides[1]) / 2, slopes[..., axis], atol=2e-3)
    groups = model.groups(25, **{k: stars[k] for k in ("epoch", "exposure", "chip")})
    position, again = model.linearised(theta, groups, stars["x"], stars["y"])
    np.testing.assert_allclose(position, model.predict(theta, **stars), rtol=1e-12)
    np.testing.assert_array_equal(again, slopes)


def test_quadrature_over_a_chip():
    chip = CHIPS[0]
    x, y, weight = chip.quadrature(3)
    (nx, ny), low = chip.size, 0.5
    for i, j in ((0, 0), (1, 0), (2, 3), (5, 5)):
        exact = [((n + low) ** (k + 1) - low ** (k + 1)) / (k + 1) for n, k in ((nx, i), (ny, j))]
        assert (weight * x**i * y**j).sum() == pytest.approx(np.prod(exact), rel=1e-12)


def test_layout():
    model = model_of("shift_rotation_scale", order=2)
    assert model.n_polynomial == 2 * 2 * 6
    assert model.n_global == 24 + 2 * 3 * 3
    assert model.n_params == 24 + 18 + 2 * 4 == len(model.names) == len(model.units)
    assert len(set(model.names)) == model.n_params
    assert model.names[:3] == ("WFC2.u_0_0", "WFC2.u_1_0", "WFC2.u_0_1")
    pick = np.array(model.names)
    assert pick[model.coefficient_slice(1, 1)][0] == "WFC1.v_0_0"
    assert list(pick[model.tdd_slice(1)][:3]) == [
        "WFC1.tdd.u_1_0.rate",
        "WFC1.tdd.u_1_0.step_2",
        "WFC1.tdd.u_1_0.rate_2",
    ]
    assert list(pick[model.frame_slice(2)]) == ["c.shift_u", "c.shift_v", "c.scale", "c.rotation"]
    units = dict(zip(model.names, model.units, strict=True))
    assert units["WFC1.u_1_1"] == "mas"
    assert units["WFC1.tdd.v_0_2.rate_2"] == "mas/yr"
    assert units["WFC1.tdd.v_0_2.step_2"] == "mas"
    assert units["b.shift_u"] == "mas" and units["b.rotation"] == ""


@in_every_gauge
def test_slices_cover_theta_once(frames, gauge):
    model = model_of(frames, **gauge)
    slices = [model.coefficient_slice(c.number, a) for c in CHIPS for a in (0, 1)]
    slices += [model.tdd_slice(c.number) for c in CHIPS]
    assert sum(s.stop - s.start for s in slices) == model.n_distortion
    slices += [model.frame_slice(0), *model.local_blocks]
    covered = np.concatenate([np.arange(model.n_params)[s] for s in slices])
    np.testing.assert_array_equal(np.sort(covered), np.arange(model.n_params))
    if not gauge:
        assert model.frame_slice(0) == slice(0, 0)
    assert model.frame_slice(-1) == slice(0, 0)


def test_deviations_of_single_chips():
    """Those of every chip but the first, in every exposure; they vanish without an exposure."""
    model = model_of("shift_rotation", **HELD_APART)
    own = ("shift_u", "shift_v", "rotation", "scale", "shear_plus", "shear_cross")
    assert model.names[model.n_distortion : model.n_global] == tuple(f"a.WFC1.{n}" for n in own)
    assert np.array(model.names)[model.frame_slice(2)].tolist() == [
        "c.shift_u",
        "c.shift_v",
        "c.rotation",
        *(f"c.WFC1.{n}" for n in own),
    ]
    found = dict(zip(model.names, model.parameters, strict=True))
    assert found["b.WFC1.shift_v"].unit == "mas" and found["b.WFC1.scale"].unit == ""
    assert found["b.WFC1.scale"].chip == 1 and found["b.shift_u"].chip is None
    assert model_of("affine", chips=CHIPS[:1], **HELD_APART).n_frame == 6
    with pytest.raises(InputError, match=r"chip_deviations: .*choose gauge 'held'"):
        model_of("affine", chip_deviations=True)


def test_what_is_held_is_no_parameter():
    """The first exposure has its deviations alone, and they stand before the local blocks."""
    model = model_of("affine", **HELD)
    assert model.names[model.n_distortion : model.n_global] == (
        "a.scale",
        "a.shear_plus",
        "a.shear_cross",
    )
    assert model.n_params == model_of("affine").n_params + 3
    assert model_of("shift_rotation", **HELD).n_params == model_of("shift_rotation").n_params
    theta, stars = some_theta(model), some_stars()
    theta[model.frame_slice(0)] = [0.1, -0.2, 0.15]
    M, d = model.frame(theta, 0)
    np.testing.assert_array_equal(d, HELD["held"][:2])
    turn, stretch = polar(M)
    assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(HELD["held"][2])
    np.testing.assert_allclose(stretch, [[0.9, 0.15], [0.15, 1.3]], atol=1e-14)
    # without an exposure: the polynomials, whatever the frames
    other = theta.copy()
    other[model.n_distortion :] += 1.0
    where = {k: v for k, v in stars.items() if k != "exposure"}
    np.testing.assert_array_equal(model.predict(other, **where), model.predict(theta, **where))


@in_every_gauge
def test_dict_round_trip_through_json(frames, gauge):
    model = model_of(frames, **gauge)
    again = DistortionModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert again == model
    assert again.names == model.names
    theta, stars = some_theta(model), some_stars()
    np.testing.assert_array_equal(again.predict(theta, **stars), model.predict(theta, **stars))
    still = DistortionModel(2, CHIPS[:1])
    assert DistortionModel.from_dict(json.loads(json.dumps(still.to_dict()))) == still


def test_numbers_of_numpy_are_described_as_plain_ones():
    chip = Chip(np.int64(2), "b", (np.float64(64.0), 32.0), (32.0, 16.0))
    model = DistortionModel(np.int64(2), (chip,), origin=tuple(np.array([1.5, 2.0])))
    text = json.dumps(model.to_dict())
    assert DistortionModel.from_dict(json.loads(text)) == model
    assert repr(model.to_dict()) == repr(json.loads(text))


def test_errors_of_the_structure():
    with pytest.raises(InputError, match=r"unknown kind of frame 'twist'.*shift_rotation"):
        model_of("twist")
    with pytest.raises(InputError, match="no chip"):
        model_of("none", chips=())
    with pytest.raises(InputError, match="v_0_2 exceeds the polynomial order 1"):
        model_of("none", order=1)
    with pytest.raises(InputError, match=r"unknown gauge 'mean'.*first or held"):
        model_of("affine", gauge="mean")
    with pytest.raises(InputError, match="there are no frames"):
        model_of("none", gauge="held")
    with pytest.raises(InputError, match="requires the identity"):
        model_of("affine", held=(1.0, 0.0, 0.0))
    with pytest.raises(InputError, match="'shift' has no rotation"):
        model_of("shift", gauge="held", held=(1.0, 0.0, 0.1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gauge": None}, "written by another version.*'gauge' is missing; fit again"),
        ({"shear": [1.0]}, "'shear' is not known"),
        ({"order": "3"}, "'order': Input should be a valid integer"),
        ({"chips": [{"number": 1}]}, "'chips.0.name': Field required"),
        ({"time": {"terms": [["u", 1]], "epoch0": [2004.5], "breaks": []}}, "'time.terms.0.2'"),
        ({"frames": "twist"}, "unknown kind of frame 'twist'"),
    ],
)
def test_descriptions_that_are_older_or_damaged_are_not_misread(change, message):
    data = model_of("affine").to_dict() | change
    data = {key: value for key, value in data.items() if value is not None}
    with pytest.raises(InputError, match=message):
        DistortionModel.from_dict(data)


def test_errors_of_prediction():
    model = model_of("affine")
    theta = some_theta(model)
    x = y = np.array([10.0, 20.0])
    with pytest.raises(InputError, match="time, but no epoch"):
        model.predict(theta, x, y)
    with pytest.raises(InputError, match="no chip 7"):
        model.predict(theta, x, y, epoch=2005.0, chip=7)
    with pytest.raises(InputError, match="no exposure 'z'"):
        model.predict(theta, x, y, epoch=2005.0, exposure="z")
    with pytest.raises(InputError, match="from 0 to 2"):
        model.predict(theta, x, y, epoch=2005.0, exposure=3)
    for wrong in (theta[:-1], np.append(theta, 0.0), np.float64(1.0)):
        with pytest.raises(InputError, match="parameters"):
            model.predict(wrong, x, y, epoch=2005.0)


def test_a_chip_that_a_model_does_not_have_is_refused():
    """As the documentation of `groups` says, for one chip as for many."""
    model = DistortionModel(2, CHIPS[:1])
    with pytest.raises(InputError, match="no chip 7"):
        model.predict(np.zeros(model.n_params), [10.0], [10.0], chip=7)


def test_names_are_unique_or_refused():
    """Priors, files and error messages find parameters by name."""
    twin = Chip(1, "WFC2", (400.0, 200.0), (200.0, 100.0))
    with pytest.raises(InputError):
        DistortionModel(2, (CHIPS[0], twin))
    with pytest.raises(InputError):
        DistortionModel(2, CHIPS[:1], frames="shift", exposures=("a", "b", "b"))


def test_no_stars_give_no_positions():
    model = model_of("affine")
    theta, none = some_theta(model), np.zeros(0)
    assert model.predict(theta, none, none, epoch=2005.0).shape == (0, 2)
    assert model.jacobian(theta, none, none, epoch=2005.0).shape == (0, 2, model.n_params)
