"""The branch-free exponential and inverse root against libm, and the logarithm of a product."""

from __future__ import annotations

import ctypes.util
import math
import os
import subprocess
import sys

import numba as nb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesdist.infer.kernel.blocks import BLOCK
from bayesdist.infer.kernel.lanes import FAST, WIDTH, load, put
from bayesdist.infer.kernel.mixture import log_of_product
from bayesdist.infer.kernel.numeric import LOWEST, bits_of, exp_negative, from_bits, inverse_root
from tests.reduced import only_in_full

SUMS = FAST | {"reassoc"}

ULP = 2  # as the docstring says; measured: see `test_two_units_of_the_last_digit`
FLOOR = math.exp(-700.0)


def compiled(flags):
    """A loop over an array with the flags of the passes: what they may reorder is part of it."""

    @nb.njit(fastmath=flags)
    def loop(x, out):
        for s in range(len(x)):
            out[s] = exp_negative(x[s])

    def over(x):
        x = np.ascontiguousarray(x, float)
        out = np.empty_like(x)
        loop(x, out)
        return out

    return over


@pytest.fixture(scope="module", params=[False, FAST, SUMS], ids=["strict", "likelihood", "sums"])
def exp(request):
    return compiled(request.param)


def libm(x) -> np.ndarray:
    """math.exp of each, which is the C library's."""
    return np.array([math.exp(t) for t in np.asarray(x, float)])


def ulps(found, expected) -> np.ndarray:
    """Steps between doubles: both are positive, so that their bits are ordered as they are."""
    return np.abs(found.view(np.int64) - expected.view(np.int64))


def arguments() -> np.ndarray:
    """The whole range, dense and at all its special places."""
    rng = np.random.default_rng(1)
    powers = -(2.0 ** np.arange(-1074, 10))  # from the smallest denormal on
    halves = -math.log(2) * (np.arange(1010) + 0.5)  # where the exponent n steps
    wholes = -math.log(2) * np.arange(1, 1011)
    special = np.concatenate([powers, halves, wholes, [LOWEST]])
    near = [special]
    for direction in (-np.inf, 0.0):
        step = special
        for _ in range(4):
            step = np.nextafter(step, direction)
            near.append(step)
    x = np.concatenate(
        [
            np.linspace(LOWEST, 0.0, 100_001),
            -rng.uniform(0, 700, 500_000),
            -(10.0 ** rng.uniform(-320, math.log10(700), 100_000)),
            -rng.uniform(0, 1, 100_000),
            *near,
        ]
    )
    return x[(x >= LOWEST) & (x <= 0)]


def test_two_units_of_the_last_digit(exp, capsys):
    x = arguments()
    off = ulps(exp(x), libm(x))
    with capsys.disabled():
        print(
            f"\nexp on {len(x)} arguments: at most {off.max()} ulp, {np.mean(off > 0):.1%} off by "
            f"any, worst at {x[off.argmax()]!r}"
        )
    assert off.max() <= ULP


@settings(deadline=None, max_examples=300)
@given(st.floats(LOWEST, 0.0))
def test_two_units_of_the_last_digit_anywhere(x):
    assert ulps(exp_scalar(x), libm([x]))[0] <= ULP


_strict = compiled(False)


def exp_scalar(x: float) -> np.ndarray:
    return _strict([x])


@pytest.mark.parametrize("x", [0.0, -0.0, -1e-300, -5e-324, -2.3e-308, -1e-17])
def test_next_to_zero_it_is_one(exp, x):
    np.testing.assert_array_equal(exp([x] * 9), 1.0)


@pytest.mark.parametrize(
    "x", [-700.0, np.nextafter(-700, -np.inf), -708.4, -746.0, -1e308, -np.inf]
)
def test_below_the_range_as_at_its_end(exp, x):
    found = exp([x] * 9)
    assert (found == exp([LOWEST])[0]).all()
    assert (ulps(found, np.full(9, FLOOR)) <= ULP).all()
    assert found[0] > np.finfo(float).tiny  # a normal number: nothing slows down


def test_it_never_falls():
    """Between neighbours that its error tells apart it rises; one never comes out above one."""
    x = np.sort(arguments())
    found = _strict(x)
    assert found.max() == 1.0
    apart = np.diff(libm(x)) > 2 * ULP * np.spacing(libm(x)[1:])
    assert (np.diff(found)[apart] > 0).all()


def test_the_flags_of_the_passes_change_nothing():
    """Reordered sums would cancel the rounding constant that finds the exponent."""
    x = arguments()
    for flags in (FAST, SUMS):
        assert ulps(compiled(flags)(x), _strict(x)).max() <= 1


@nb.njit
def _there(x):
    return bits_of(x)


@nb.njit
def _and_back(x):
    return from_bits(bits_of(x))


@pytest.mark.parametrize("x", [1.0, -0.0, 5e-324, 1e308, np.inf, math.pi])
def test_bits_are_those_of_the_double(x):
    assert _there(x) == np.float64(x).view(np.int64)
    assert np.float64(_and_back(x)).view(np.int64) == np.float64(x).view(np.int64)


# -- the logarithm of a product -------------------------------------------------------------------


@nb.njit
def _log_of_product(room):
    return log_of_product(room)


def by_kernel(density) -> float:
    room = np.ones((1, BLOCK))
    room[0, : len(density)] = density
    return float(_log_of_product(room))


def one_by_one(density) -> float:
    return math.fsum(math.log(d) for d in density)


def assert_is_the_sum(density):
    size = math.fsum(abs(math.log(d)) for d in density)
    # one rounding of each product, and of each sum where the logarithms are taken one by one
    assert by_kernel(density) == pytest.approx(one_by_one(density), rel=0, abs=4e-15 * (size + 1))


@pytest.mark.parametrize("n", [0, 1, 2, 31, 32, 33, 255, 256])
@pytest.mark.parametrize("decades", [0.1, 3.0, 12.0])
def test_log_of_a_product(n, decades):
    rng = np.random.default_rng(n)
    assert_is_the_sum(10 ** rng.uniform(-decades, decades, n))


@pytest.mark.parametrize("density", [1.0, 0.999, 2.0, 1e-12, 1e12, 1.7976931348623157e308, 1e-300])
def test_log_of_a_power(density):
    assert_is_the_sum([density] * BLOCK)


@pytest.mark.parametrize("decades", [40.0, 60.0, 120.0, 300.0])
@pytest.mark.parametrize("seed", range(20))
def test_log_of_a_product_that_over_or_underflows(decades, seed):
    """Also where it does so on the way only: small and large ones in the same eight."""
    rng = np.random.default_rng(seed)
    assert_is_the_sum(10 ** rng.uniform(-decades, decades, BLOCK))
    assert_is_the_sum(10 ** (decades * rng.choice([-1.0, 0.0, 1.0], BLOCK)))


@pytest.mark.parametrize("lane", [0, WIDTH - 1])
@pytest.mark.parametrize(
    "eight",
    [
        [1e-62] * 5 + [1e60] * 3,  # 1e-310 on the way, where digits are lost: 1e-130 in the end
        [1e-60] * 6 + [1e60] * 2,
        [1e60] * 6 + [1e-60] * 2,  # overflow on the way
        [3e-160, 7e-163, 1e90],  # denormal on the way
        [1e-300, 1e300],
    ],
    ids=str,
)
def test_digits_that_are_lost_on_the_way(eight, lane):
    density = np.ones(BLOCK)
    density[lane::WIDTH][: len(eight)] = eight
    assert_is_the_sum(density)


def test_no_density_at_all():
    assert by_kernel([1.0, 0.0, 2.0]) == -math.inf
    assert math.isnan(by_kernel([1.0, math.nan, 2.0]))


def test_the_library_of_c_is_there():
    """`math.exp` is the reference only where it is the C library's own."""
    name = ctypes.util.find_library("m")
    if name is None:
        pytest.skip("no mathematics library of C is found")
    c = ctypes.CDLL(name).exp
    c.restype, c.argtypes = ctypes.c_double, [ctypes.c_double]
    assert all(c(t) == math.exp(t) for t in (-0.1, -1.0, -33.3, -699.9))


def test_inverse_root_is_within_two_units_of_the_last_digit():
    @nb.njit(fastmath=FAST)
    def loop(x, out):
        for s in range(0, x.shape[1], WIDTH):
            put(out, 0, s, inverse_root(load(x, 0, s)))

    rng = np.random.default_rng(2)
    mantissas = np.concatenate([np.linspace(1.0, 4.0, 100_001), rng.uniform(1, 4, 100_000)])
    wide = mantissas * 4.0 ** rng.integers(-510, 510, mantissas.size)
    edges = np.array([np.finfo(float).tiny, np.finfo(float).max])
    x = np.concatenate([mantissas, wide, edges])
    x = np.append(x, np.ones(-len(x) % WIDTH))
    found = np.empty_like(x)
    loop(x[None], found[None])
    assert ulps(found, np.array([1.0 / math.sqrt(t) for t in x])).max() <= ULP


@pytest.mark.slow
@only_in_full("the processor that runs is tested")
def test_inverse_root_of_a_processor_without_avx_512(tmp_path):
    """In a process that compiles for one: the test above, and that it is one."""
    test = f"{__file__}::{test_inverse_root_is_within_two_units_of_the_last_digit.__name__}"
    code = (
        "import sys, pytest; from bayesdist.infer.kernel import lanes; assert not lanes.HAS_512; "
        f"sys.exit(pytest.main(['-q', '-n', '0', {test!r}]))"
    )
    other = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | other | {"NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
