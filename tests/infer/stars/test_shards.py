"""The sum over pieces of the data is the sum over the whole, wherever the pieces come from."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesdist.data import open_matches, write_partitioned
from bayesdist.errors import InputError
from bayesdist.infer import Compute, GaussianPriors, OutlierMixture, Rejection, fit_linear, load
from bayesdist.infer.density.target import Target
from bayesdist.infer.equations.normal import least_squares, mixture
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.infer.stars.shards import total
from bayesdist.infer.stars.stars import in_table_order, prepare
from bayesdist.model import DistortionModel, TimeDependence
from tests.batched import in_batches
from tests.reduced import case_in_full

from ..support import CHIP, TWO_CHIPS, residual_of, simulated

pytestmark = pytest.mark.usefixtures("one_thread")

PSI = (-4.0, -3.0, -0.2)
MIXTURE = OutlierMixture()


@pytest.fixture(scope="module")
def campaign():
    """Two chips, four exposures at other epochs; the rows are shuffled, so that groups mix."""
    rng = np.random.default_rng(2)
    model, matches, truth = simulated(
        111,
        1200,
        order=3,
        frames="shift_rotation",
        n_exposures=4,
        chips=TWO_CHIPS,
        time=TimeDependence((("u", 1, 0),), (2005.0,)),
        epochs=[2003.0, 2005.0, 2007.0, 2009.0],
        fraction=0.05,
        sigma=tuple(rng.uniform(0.02, 0.1, (2, 1200))),
    )
    return model, matches.select(rng.permutation(1200)), truth.theta


@pytest.fixture(scope="module")
def parquet(campaign, tmp_path_factory):
    """The same stars in three parts of several row groups each."""
    _, matches, _ = campaign
    folder = tmp_path_factory.mktemp("parts")
    cuts = [np.arange(0, 500), np.arange(500, 507), np.arange(507, 1200)]
    write_partitioned((matches.select(k) for k in cuts), folder, rows_per_group=130)
    return folder


def sums_of(shards, theta):
    """Everything that is ever summed over shards."""
    hyper = MIXTURE.bind(0.05)
    constants = hyper.constants(np.array([PSI]))
    target = Target(shards, MIXTURE, GaussianPriors.none(shards.model))
    psi = np.concatenate([theta, PSI])
    return {
        "least squares": shards.sum(least_squares, theta, Clip(theta + 1e-5, 30.0, 1.0), 2.0),
        "squared weights": shards.sum(least_squares, theta, None, 2.0, 2),
        "mixture": shards.sum(mixture, theta, constants),
        "EM": shards.sum(mixture, theta, constants, True),
    }, target.log_density(np.array([psi, psi + 1e-4]))


def assert_same(found, expected, rel=1e-12):
    sums, density = found
    for name, one in sums.items():
        two = expected[0][name]
        assert one.groups.same(two.groups), name
        for field in ("weight", "right", "cross", "scalars", "about"):
            a, b = getattr(one, field), getattr(two, field)
            # relative to the sums of their kind, which signs cancel
            size = np.abs(b).max() if b.size else 0.0
            np.testing.assert_allclose(a, b, rtol=rel, atol=rel * size, err_msg=f"{name} {field}")
        assert one.chi2 == pytest.approx(two.chi2, rel=rel)
    np.testing.assert_allclose(density, expected[1], rtol=rel)


@pytest.mark.parametrize("size", [case_in_full(1, instead="larger pieces are run"), 37, 500, 1200])
def test_pieces_of_a_table(campaign, size):
    model, matches, theta = campaign
    whole = load(model, matches)
    assert len(matches.readers()) == 1
    assert len(matches.readers(size)) == -(-1200 // size)
    cut = load(model, in_batches(matches, size))
    assert len(cut) == len(whole) == 1200 and cut.groups.same(whole.groups)
    assert_same(sums_of(cut, theta), sums_of(whole, theta))


@pytest.mark.parametrize("piece", [130, 400, 2**20])
def test_parts_on_disk(campaign, parquet, piece):
    model, matches, theta = campaign
    on_disk = open_matches(parquet, batch_rows=piece)
    assert (len(on_disk.readers()) == 1) == (piece > 1200)
    model = _in_order_of(model, on_disk.exposure_names)
    renamed = _with_names_of(matches, on_disk.exposure_names)
    assert_same(sums_of(load(model, on_disk), theta), sums_of(load(model, renamed), theta))


def _in_order_of(model, names):
    return DistortionModel(**{**_fields(model), "exposures": tuple(names)})


def _fields(model):
    names = ("order", "chips", "unit", "time", "frames", "exposures", "origin")
    return {name: getattr(model, name) for name in names}


def _with_names_of(matches, names):
    """The table with its exposures named in another order, as the files name them."""
    code = np.array([names.index(name) for name in matches.exposure_names])
    columns = {k: getattr(matches, k) for k in ("x", "y", "u", "v", "sigma_u", "sigma_v", "epoch")}
    return type(matches)(
        **columns,
        exposure=code[matches.exposure],
        exposure_names=tuple(names),
        chip=matches.chip,
        chip_numbers=matches.chip_numbers,
    )


@settings(deadline=None, max_examples=25)
@given(st.lists(st.integers(1, 1199), max_size=6, unique=True), st.integers(0, 10_000))
def test_any_cut_into_any_pieces(cuts, seed):
    model, matches, theta = _small()
    rows = np.random.default_rng(seed).permutation(len(matches))
    parts = [k for k in np.split(rows, sorted(c % len(rows) for c in cuts)) if len(k)]
    whole = least_squares(prepare(model, matches)[0], theta)
    added = total(least_squares(prepare(model, matches.select(k))[0], theta) for k in parts)
    assert added.groups.same(whole.groups)
    for name in ("weight", "right", "scalars"):
        a, b = getattr(added, name), getattr(whole, name)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())


def _small():
    model, matches, truth = simulated(112, 60, frames="shift", n_exposures=3, chips=TWO_CHIPS)
    return model, matches, truth.theta


def test_the_fit_does_not_depend_on_the_pieces(campaign, parquet):
    model, matches, _ = campaign
    whole = fit_linear(matches, model, rejection=Rejection(radial_weight=2.0))
    cut = fit_linear(in_batches(matches, 100), model, rejection=Rejection(radial_weight=2.0))
    np.testing.assert_allclose(
        cut.mean / whole.sigma, whole.mean / whole.sigma, rtol=1e-11, atol=1e-5
    )
    np.testing.assert_allclose(cut.cov, whole.cov, rtol=0, atol=1e-9 * np.abs(whole.cov).max())
    assert (cut.n_used, cut.rejected) == (whole.n_used, whole.rejected)
    assert cut.chi2 == pytest.approx(whole.chi2, rel=1e-9)
    np.testing.assert_array_equal(cut.uses(matches), whole.uses(matches))


def test_a_model_need_not_know_the_exposures_that_it_has_no_frames_for(campaign):
    """One polynomial for all exposures, of which pieces hold some and other ones."""
    _, matches, _ = simulated(113, 300, n_exposures=4)
    model = DistortionModel(2, (CHIP,))
    whole = fit_linear(matches, model)
    # the exposures stand one after the other
    cut = fit_linear(in_batches(matches, 50), model)
    np.testing.assert_allclose(cut.mean, whole.mean, rtol=1e-12)
    assert load(model, matches).survey.exposures.shape == (1,)


def test_results_add_up_in_the_order_of_the_data(campaign):
    """A sum of doubles depends on its order: the order is that of the rows."""
    model, matches, _ = campaign
    matches = in_batches(matches, 300)
    shards = load(model, matches)
    first = shards.sum(_first_u)
    assert first == tuple(
        float(piece.load().u[_first_row(model, piece)]) for piece in matches.readers()
    )
    assert total([3.0]) == 3.0
    assert total(iter([1e16, 1.0, 1.0])) == (1e16 + 1.0) + 1.0 != 1e16 + 2.0
    with pytest.raises(ValueError, match="no parts"):
        total([])


def _first_u(stars):
    return (float(stars.u[0]),)


def _first_row(model, piece):
    return prepare(model, piece.load())[1][0]


def test_shards_are_given_back_as_they_are(campaign):
    model, matches, _ = campaign
    shards = load(model, matches)
    assert load(model, shards) is shards
    shards.close()


def test_engines_that_are_not_there_are_refused():
    with pytest.raises(InputError, match=r"compute\.engine: there is no engine 'spark'"):
        Compute(engine="spark")


# -- one shard -----------------------------------------------------------------------------------


def test_a_shard_holds_the_stars_of_the_table(campaign):
    """Sorted by group, in the order of the table within each; the order tells the way back."""
    model, matches, theta = campaign
    stars, order = prepare(model, matches)
    assert sorted(order) == list(range(1200))
    np.testing.assert_array_equal(stars.u, matches.u[order])
    np.testing.assert_array_equal(stars.var_v, matches.sigma_v[order] ** 2)
    x, y = stars.pixels()
    np.testing.assert_allclose(x, matches.x[order], atol=1e-10)
    np.testing.assert_allclose(y, matches.y[order], atol=1e-10)
    assert np.abs(stars.X).max() <= 1 and np.abs(stars.Y).max() <= 1
    group = np.repeat(np.arange(len(stars.groups)), np.diff(stars.starts))
    np.testing.assert_array_equal(stars.groups.chip[group], matches.chip[order])
    np.testing.assert_array_equal(stars.groups.exposure[group], matches.exposure[order])
    np.testing.assert_array_equal(stars.groups.epoch[group], matches.epoch[order])
    for g in range(len(stars.groups)):
        assert (np.diff(order[group == g]) > 0).all()
    back = in_table_order(stars.residuals(theta), order)
    np.testing.assert_allclose(back, residual_of(model, theta, matches), atol=1e-9)


@pytest.mark.parametrize("chips", [(CHIP,), TWO_CHIPS])
def test_preparing_changes_no_input(chips):
    model, matches, _ = simulated(114, 100, chips=chips)
    before = {k: getattr(matches, k).copy() for k in ("x", "y", "u", "v", "sigma_u", "sigma_v")}
    fit_linear(matches, model, rejection=Rejection(clip_abs=None))
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(matches, name), values)


def test_shards_of_another_model_are_refused():
    model, matches, _ = simulated(51, 300)
    other = replace(model, chips=(replace(model.chips[0], size=(2000.0, 1600.0)),))
    shards = load(model, matches)
    with pytest.raises(InputError, match="another model"):
        fit_linear(shards, other)
    with pytest.raises(InputError, match="matches is a str; give a Matches or Shards"):
        fit_linear("stars.ecsv", model)  # type: ignore[arg-type]


@pytest.mark.parametrize("memory", [-1.0, np.nan, np.inf])
def test_a_budget_that_is_no_budget_is_refused(memory):
    with pytest.raises(InputError, match=r"compute\.memory_mb"):
        Compute(memory_mb=memory)


@pytest.mark.parametrize("in_order", [False, True], ids=["mixed", "assumed motions last"])
def test_the_scale_of_priors_is_that_of_stars_with_a_measured_motion(in_order):
    """With 60 % of assumed motions, in several pieces, some of which may have no others."""
    rng, n = np.random.default_rng(12), 600
    assumed = rng.random(n) < 0.6
    if in_order:
        assumed = np.sort(assumed)
    model, matches, _ = simulated(12, n, chips=TWO_CHIPS, frames="shift_rotation", n_exposures=4)
    sigma = np.where(assumed, 2.0, rng.uniform(0.02, 0.06, n))
    marked = matches.with_errors((sigma, sigma)).with_columns(assumed_motion=assumed.astype(int))
    middle = np.sqrt(np.median(sigma[~assumed] ** 2))
    with closing(load(model, in_batches(marked, 150))) as shards:
        assert shards.survey.reference_sigma == pytest.approx(middle, rel=1e-9)
    none = marked.with_columns(assumed_motion=np.ones(n, int))
    with closing(load(model, in_batches(none, 150))) as shards:
        assert shards.survey.reference_sigma == pytest.approx(
            np.sqrt(np.median(sigma**2)), rel=1e-9
        )
