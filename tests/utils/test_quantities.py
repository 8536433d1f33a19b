"""Quantities, dates, directions and seeds, and where the public functions take them."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time

import bayesdist as bd
from bayesdist.data import catalog_from_table, match_table
from bayesdist.errors import InputError
from bayesdist.utils.quantities import (
    direction_in,
    generator_of,
    unit_name,
    value_in,
    values_in,
    year_of,
)


def test_values_are_converted():
    assert value_in(1 * u.deg, "arcsec", "x") == pytest.approx(3600.0)
    assert value_in(2, "arcsec", "x") == 2.0
    assert values_in((1 * u.arcmin, 30 * u.arcsec), "arcsec", "x").tolist() == [60.0, 30.0]
    assert unit_name(1 * u.arcsec, "x") == "arcsec" and unit_name(1.0, "x") is None
    assert unit_name(1 * u.arcmin, "x") == "mas"


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: value_in(1 * u.m, "arcsec", "limit"), "limit is given in m, which cannot be conv"),
        (lambda: value_in([1, 2] * u.mas, "mas", "limit"), "limit has 2 values; give one number"),
        (lambda: value_in("x", "mas", "limit"), "limit is 'x', which is not a number"),
        (lambda: unit_name(1 * u.s, "limit"), "limit is given in s"),
        (lambda: year_of("soon"), "epoch is 'soon', which is not a date; give"),
        (lambda: year_of(57000.0), "epoch is 57000, which is not a year"),
        (lambda: year_of(3 * u.m), "which is not a date"),
        (lambda: year_of(Time(["2020-01-01", "2021-01-01"])), "which is not a date"),
        (lambda: direction_in("M31", "point"), "point is 'M31', which is not a direction"),
        (lambda: direction_in((0.0, 91.0), "point"), r"point is \(0, 91\), which is not"),
        (lambda: direction_in(SkyCoord([1, 2], [3, 4], unit="deg"), "point"), "has 2 directions"),
        (lambda: generator_of("x"), "rng is 'x', which is neither a seed nor a generator; give a"),
        (lambda: generator_of(-1), "rng is -1, which is neither a seed nor a generator"),
        (lambda: generator_of(True), "rng is True, which is neither"),
    ],
)
def test_wrong_values_are_one_sentence(call, says):
    with pytest.raises(InputError, match=says):
        call()


@pytest.mark.parametrize(
    "epoch",
    [
        2016.5,
        "2016.5",
        2016.5 * u.yr,
        Time(2016.5, format="decimalyear"),
        "2016-07-02",
        datetime.date(2016, 7, 2),
        datetime.datetime(2016, 7, 2),
        np.datetime64("2016-07-02"),
        57571 * u.d,
    ],
)
def test_dates_are_decimal_years(epoch):
    assert year_of(epoch) == pytest.approx(2016.5, abs=1e-3)


def test_directions_are_icrs_degrees():
    sky = SkyCoord(30 * u.deg, -5 * u.deg)
    for point in ((30.0, -5.0), sky, sky.galactic, (2 * u.hourangle, -300 * u.arcmin)):
        assert direction_in(point, "point") == pytest.approx((30.0, -5.0))


def test_seeds_are_generators():
    assert generator_of(3).normal() == np.random.default_rng(3).normal()
    generator = np.random.default_rng(3)
    assert generator_of(generator) is generator and generator_of(np.int64(3)) is not None


# -- public functions -----------------------------------------------------------------------------


def simulated(**options):
    chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
    model = bd.DistortionModel(1, (chip,), "arcsec")
    return bd.simulate_matches(model, [0, 50, 0, 0, 0, 50], 300, **options)[0], model


def test_simulations_take_seeds_and_units():
    plain, _ = simulated(rng=np.random.default_rng(1), sigma=0.01, fraction=0.0)
    other, _ = simulated(rng=1, sigma=10 * u.mas, fraction=0.0)
    np.testing.assert_array_equal(plain.u, other.u)
    np.testing.assert_allclose(plain.sigma_u, other.sigma_u)


def test_sizes_and_limits_have_units():
    stars, _ = simulated(rng=1, sigma=0.01)
    plain = bd.build_model(stars, order=1, size=(1000, 1000))
    assert bd.build_model(stars, order=1, size=(1000 * u.pix, 1000 * u.pix)) == plain
    assert bd.build_model(stars, order=1, size=(1000, 1000) * u.pix) == plain
    assert bd.Rejection(clip_abs=3 * u.pix).clip_abs == 3.0
    with pytest.raises(InputError, match="size is given in mm, which cannot be converted to pix"):
        bd.build_model(stars, order=1, size=(36 * u.mm, 24 * u.mm))
    chip = bd.Chip(1, "c", (1000, 900) * u.pix, (500.5 * u.pix, 450.5 * u.pix))
    assert chip.size == (1000.0, 900.0) and chip.reference_pixel == (500.5, 450.5)
    need = bd.Requirement("r", "p95", 5 * u.mas, epoch=Time(2024.5, format="decimalyear"))
    assert (need.limit, need.unit, need.epoch) == (5.0, "mas", pytest.approx(2024.5))
    near = bd.Requirement("r", "p95", 0.1, relative=True, separation=200 * u.pix)
    assert near.separation == 200.0
    term = bd.UserTerm("filter", "systematic", 2 * u.mas, 3 * u.mas)
    assert (term.sigma_u, term.sigma_v, term.unit) == (2.0, 3.0, "mas")


def test_outlier_mixtures_have_units():
    mixture = bd.OutlierMixture("uniform", match_radius=500 * u.mas, jitter_scale=1 * u.mas)
    plain = mixture.in_unit("arcsec")
    assert plain == bd.OutlierMixture("uniform", match_radius=0.5, jitter_scale=0.001)
    assert plain.in_unit("arcsec") is plain
    with pytest.raises(InputError, match="match_radius is given in pix, which cannot be converted"):
        bd.OutlierMixture("uniform", match_radius=2 * u.pix).in_unit("arcsec")
    with pytest.raises(InputError, match="need the radius of the match circle"):
        bd.OutlierMixture("uniform", match_radius=-2 * u.pix)


def test_sampling_takes_units_and_the_radius_of_the_matches():
    stars, model = simulated(rng=1, sigma=0.01, fraction=0.02, outlier_scale=0.2)
    options = {"seed": 1, "target_ess": 50, "max_steps": 40}
    fit = bd.fit_linear(stars, model)
    plain = bd.sample(fit, stars, outliers=bd.OutlierMixture("uniform", 2.0), **options)
    mixture = bd.OutlierMixture("uniform", 2000 * u.mas)
    other = bd.sample(fit, stars, outliers=mixture, **options)
    np.testing.assert_array_equal(plain.theta, other.theta)
    assert other.mixture.match_radius == 2.0
    matched = stars.with_columns(match_radius=3.0)
    assert bd.sample(fit, matched, **options).mixture.match_radius == 3.0
    np.testing.assert_array_equal(plain.draws(5, 1), plain.draws(5, np.random.default_rng(1)))


def test_maps_and_catalogues_take_times():
    stars, model = simulated(rng=1, sigma=0.01)
    fit = bd.fit_linear(stars, model)
    assert bd.uncertainty_map(fit, grid=(3, 3), epoch=Time("2020-01-01")).epoch is not None
    table = {"ra": [10.0, 10.01], "dec": [5.0, 5.01], "pmra": [10, 20] * u.mas / u.yr,
             "pmdec": [10, 20] * u.mas / u.yr}  # fmt: skip
    point = SkyCoord(10 * u.deg, 5 * u.deg)
    catalogue = catalog_from_table(table, epoch=Time(2016.0, format="decimalyear"),
                                   tangent_point=point)  # fmt: skip
    plain = catalog_from_table(table, epoch=2016.0, tangent_point=(10.0, 5.0))
    np.testing.assert_allclose(catalogue.u, plain.u)
    np.testing.assert_allclose(catalogue.at("2020-01-01").u, plain.at(2020.0).u)
    rng = np.random.default_rng(1)
    u_, v_ = rng.uniform(0.0, 1000.0, (2, 60))
    reference = bd.ReferenceCatalog(u=u_, v=v_, unit="arcsec")
    seen = bd.Matches(u_ + 1.0, v_ - 2.0, u_ + 1.0, v_ - 2.0, unit="arcsec")
    assert len(match_table(seen, reference, radius=2000 * u.mas)) == 60
