from __future__ import annotations

import astropy.units as apu
import numpy as np
import pytest
from astropy.utils.masked import Masked

from bayesdist.data import Matches
from bayesdist.errors import InputError


def table(n=5, **changes):
    k = np.arange(n, dtype=float)
    columns = {"x": 10 + k, "y": 20 + k, "u": 0.5 * k, "v": -k, "sources": ("stars.ecsv",)}
    return Matches(**{**columns, **changes})


def test_defaults_are_one_exposure_and_one_chip():
    t = table()
    assert len(t) == t.n_rows == 5
    assert t.exposure_names == ("1",) and t.chip_numbers == (1,) and t.filter_names == ("",)
    assert t.exposure.tolist() == t.chip.tolist() == [0] * 5
    assert t.row.tolist() == [0, 1, 2, 3, 4]
    assert t.rejected == {} and t.sigma_u is None and t.epoch is None


def test_foreign_byte_order_and_type_become_float64():
    t = table(x=np.arange(5, dtype=">f4"), y=[1, 2, 3, 4, 5])
    assert t.x.dtype == t.y.dtype == np.dtype("=f8")


@pytest.mark.parametrize("name", ["x", "y", "u", "v", "epoch", "mag", "colour", "sigma_u"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e250])
def test_values_that_are_not_finite_are_named(name, value):
    columns = {"sigma_u": np.ones(5), "sigma_v": np.ones(5), "epoch": np.full(5, 2e3)}
    columns |= {"mag": np.ones(5), "x": np.arange(5.0), "y": np.ones(5), "u": np.ones(5)}
    columns |= {"v": np.ones(5), "colour": np.ones(5)}
    columns[name][3] = value
    with pytest.raises(InputError, match=rf"stars\.ecsv, row 4, column '{name}': value is"):
        table(**columns)


@pytest.mark.parametrize("value", [0.0, -0.1])
def test_errors_must_be_positive(value):
    sigma = np.array([1, 1, value, 1, 1])
    with pytest.raises(InputError, match=r"row 3, column 'sigma_v'.*positive"):
        table(sigma_u=np.ones(5), sigma_v=sigma)


def test_masked_values_are_left_out_and_counted():
    v = np.ma.MaskedArray([0.0, -1.0, 99999.0, -3.0, -4.0], mask=[0, 0, 1, 0, 0])
    mag = Masked(np.arange(5.0), mask=[0, 0, 1, 1, 0])
    t = table(v=v, mag=mag)
    assert t.rejected == {"no value in column 'v'": 1, "no value in column 'mag'": 1}
    assert (len(t), t.n_rows, t.row.tolist()) == (3, 5, [0, 1, 4])
    assert t.v.tolist() == [0.0, -1.0, -4.0] and type(t.v) is np.ndarray
    assert t.mag.tolist() == [0, 1, 4]
    with pytest.raises(InputError, match="no rows"):
        table(v=np.ma.MaskedArray(np.zeros(5), mask=True))
    # what is not finite and not masked is an error of its own row
    v = np.ma.MaskedArray([0.0, -1.0, 99999.0, np.nan, -4.0], mask=[0, 0, 1, 0, 0])
    with pytest.raises(InputError, match=r"row 4, column 'v': value is nan"):
        table(v=v)


def test_quantities_are_converted():
    k = np.arange(5.0)
    t = table(u=(k + 1) * apu.deg, v=Masked(k * apu.mas, mask=k == 4), unit="arcsec",
              sigma_u=np.ones(5) * apu.mas, sigma_v=np.ones(5), pm_u=k * apu.mas / apu.yr,
              pm_v=k, x=k * apu.pix)  # fmt: skip
    assert t.u.tolist() == [3600, 7200, 10800, 14400] and t.rejected == {
        "no value in column 'v'": 1
    }
    np.testing.assert_allclose(t.v, [0, 1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(t.sigma_u, 1e-3)
    np.testing.assert_allclose(t.pm_u, [0, 1e-3, 2e-3, 3e-3])
    with pytest.raises(InputError, match="column 'x': unit mm cannot be converted to pix"):
        table(x=k * apu.mm)


def test_half_a_pair_of_errors_is_refused():
    with pytest.raises(InputError, match="sigma_v"):
        table(sigma_u=np.ones(5))


def test_empty_unequal_and_unknown_are_refused():
    with pytest.raises(InputError, match="no rows"):
        table(0)
    with pytest.raises(InputError, match="'u' has shape"):
        table(u=np.ones(4))
    with pytest.raises(InputError, match="unit is 'parsec'"):
        table(unit="parsec")
    with pytest.raises(InputError, match="codes in 'chip'"):
        table(chip=np.full(5, 1))


def test_the_first_repeated_row_is_named_with_its_original():
    columns = {name: np.array([1.0, 2, 3, 2, 1]) for name in "xyuv"}
    with pytest.raises(InputError, match=r"row 4: repeats stars\.ecsv, row 2"):
        table(**columns)
    # the same position measured in another exposure is another measurement
    assert len(table(**columns, exposure=[0, 0, 0, 1, 1], exposure_names=("a", "b"))) == 5
    assert len(table(**columns, chip=[0, 0, 0, 1, 1], chip_numbers=(1, 2))) == 5


def test_signed_zeros_are_equal():
    with pytest.raises(InputError, match="repeats"):
        table(2, x=[0.0, -0.0], y=[1, 1], u=[1, 1], v=[1, 1])


def test_select_keeps_rows_and_counts_what_goes():
    t = table(mag=np.arange(5.0))
    kept = t.select([True, False, True, False, True], reason="faint")
    assert kept.row.tolist() == [0, 2, 4] and kept.mag.tolist() == [0, 2, 4]
    assert kept.rejected == {"faint": 2} and kept.n_rows == 5
    assert kept.select([0, 1], reason="faint").rejected == {"faint": 3}
    assert t.rejected == {} and len(t) == 5
    with pytest.raises(InputError, match="no rows"):
        t.select(np.zeros(5, bool))
    with pytest.raises(InputError, match="repeats"):
        t.select([1, 1])


def test_numbers_of_the_chips():
    t = table(chip=[1, 0, 1, 1, 0], chip_numbers=(2, 7))
    assert t.chip_number.tolist() == [7, 2, 7, 7, 2]
    assert t.select([2, 4]).chip_number.tolist() == [7, 2]


def test_errors_are_one_number_or_one_for_each():
    t = table().with_errors((0.1, np.arange(1.0, 6.0)))
    assert t.sigma_u.tolist() == [0.1] * 5 and t.sigma_v.tolist() == [1, 2, 3, 4, 5]


def test_concatenate_joins_equal_names_and_counts():
    a = table(exposure=[0, 0, 1, 1, 1], exposure_names=("e1", "e2"), chip_numbers=(2,))
    b = table(x=np.arange(5.0), exposure_names=("e2",), chip_numbers=(1,), sources=("b.csv",))
    a, b = a.select(np.arange(4), reason="late"), b.select(np.arange(3), reason="late")
    t = Matches.concatenate([a, b])
    assert t.exposure_names == ("e1", "e2") and t.exposure.tolist() == [0, 0, 1, 1, 1, 1, 1]
    assert t.chip_numbers == (1, 2) and t.chip.tolist() == [1, 1, 1, 1, 0, 0, 0]
    assert t.sources == ("stars.ecsv", "b.csv") and t.source.tolist() == [0] * 4 + [1] * 3
    assert t.n_rows == 10 and t.rejected == {"late": 3}
    assert t.row.tolist() == [0, 1, 2, 3, 0, 1, 2]


def test_concatenate_refuses_what_does_not_fit():
    with pytest.raises(InputError, match=r"unit is mas, but pix in stars\.ecsv"):
        Matches.concatenate([table(), table(unit="mas", sources=("b",))])
    with pytest.raises(InputError, match=r"b: has no 'mag', but stars\.ecsv does"):
        Matches.concatenate([table(mag=np.ones(5)), table(sources=("b",))])
    with pytest.raises(InputError):
        Matches.concatenate([])


def test_an_error_in_a_joined_table_names_the_right_file():
    t = Matches.concatenate([table(), table(x=np.arange(5.0), sources=("b.csv",))])
    with pytest.raises(InputError, match=r"b\.csv, row 2, column 'sigma_u'"):
        t.with_errors((np.where(np.arange(10) == 6, -1.0, 1.0), 1.0))
