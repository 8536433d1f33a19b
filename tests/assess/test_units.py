import itertools

import astropy.units as u
import pytest

from bayesdist.assess import convert, pixel_scale_of
from bayesdist.data.tables.column import UNITS
from bayesdist.errors import InputError
from bayesdist.infer.posterior.checks import pixel_doubt

SCALE = 49.7  # mas, ACS/WFC


@pytest.mark.parametrize(("a", "b"), list(itertools.product(UNITS, UNITS)))
def test_conversions_are_those_of_astropy(a, b):
    expected = (0.37 * u.Unit(a)).to(u.Unit(b), u.pixel_scale(SCALE * u.mas / u.pix))
    assert convert(0.37, a, b, SCALE) == pytest.approx(expected.value, rel=1e-13)


def test_angles_need_no_scale_and_pixels_do():
    assert convert(2.0, "deg", "arcsec") == 7200.0
    assert convert(2.0, "pix", "pix") == 2.0
    for pair in (("pix", "mas"), ("arcsec", "pix")):
        with pytest.raises(InputError, match=r"key: .*give detector\.scale_mas"):
            convert(1.0, *pair, where="key")


def test_unknown_units_and_scales_are_refused():
    with pytest.raises(InputError, match="'arcsec' if that is meant"):
        convert(1.0, "arcsecs", "mas")
    for scale in (0.0, -3.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="scale is"):
            convert(1.0, "pix", "mas", scale)


@pytest.fixture
def anisotropic(from_monomials):
    def make(unit):
        return from_monomials(
            {(1, 0): 0.04, (2, 0): 1e-7},
            {(1, 0): 0.02, (0, 1): -0.0625},
            order=2,
            size=(500.0, 300.0),
            reference_pixel=(100.0, 200.0),
            unit=unit,
        )

    return make


def test_the_scale_of_an_angular_solution_is_its_own(anisotropic):
    assert pixel_scale_of(anisotropic("arcsec")) == pytest.approx(50.0, rel=1e-12)
    assert pixel_scale_of(anisotropic("mas")) == pytest.approx(0.05, rel=1e-12)
    assert pixel_scale_of(anisotropic("arcsec"), scale_mas=49.7) == 49.7


def test_the_scale_of_a_solution_in_pixels_must_be_given(anisotropic):
    assert pixel_scale_of(anisotropic("pix")) is None
    assert pixel_scale_of(anisotropic("pix"), scale_mas=49.7) == 49.7
    with pytest.raises(InputError, match="scale is -1"):
        pixel_scale_of(anisotropic("pix"), scale_mas=-1.0)


@pytest.mark.parametrize(
    ("pixel", "doubted"), [(1.0, False), (0.5, False), (0.009, True), (40, True)]
)
def test_millimetres_that_are_called_pixels_are_doubted(from_monomials, pixel, doubted):
    """Pixels of 9 micrometres in mm, as a fibre instrument's metrology has them."""
    linear = {(1, 0): pixel}, {(0, 1): -pixel}
    chip = {"order": 2, "size": (6000.0, 6000.0), "reference_pixel": (3000.5, 3000.5)}
    text = pixel_doubt(from_monomials(*linear, unit="pix", **chip))
    assert bool(text) == doubted
    if doubted:
        assert f"one pixel of x, y is {pixel:.4g} of theirs" in text
    assert pixel_doubt(from_monomials(*linear, unit="arcsec", **chip)) == ""
