"""What the single functions of the Python interface claim of truths outside the family.

The truths are those of the command line's suite, and some that only stand here. A limit is 0.9
times the 95th percentile of the actual error, so that 'met' is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

import bayesdist as bd

from . import KINDS, fields
from .python_face import Steps, carried
from .static_kinds import of_map
from .truth import Truth, mapped, observed, order_config, pixels

pytestmark = pytest.mark.slow

STARS = 3000


def strong_structure(rng: np.random.Generator) -> Truth:
    """Structure of 0.01 px rms at a scale of 270 px, beside a polynomial of order 3."""
    return of_map(rng, STARS, fields.smooth(rng, 270, 0.01))


def pixel_phase(rng: np.random.Generator) -> Truth:
    """Displacements of up to 0.01 px by the phase of the pixel."""
    return of_map(rng, STARS, fields.ridges(rng, 1.0, 0.01))


def tilted_exposures(rng: np.random.Generator) -> Truth:
    """Four aligned exposures that are turned by about 1e-5 each, fitted without frames."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, STARS)
    code = np.arange(STARS) % 4
    w = true_map(x, y, None)
    turn = 1e-5 * rng.standard_normal(4)[code, None]
    w = w + turn * np.column_stack([-w[:, 1], w[:, 0]])
    names = np.array([f"e{k}" for k in code])
    return Truth(observed(rng, x, y, w, exposure=names), true_map, order_config(3))


def magnitude_shift(rng: np.random.Generator) -> Truth:
    """Stars are displaced along v by 0.004 px per magnitude; true is a star of magnitude 14."""
    true_map = mapped(fields.distortion(rng))
    x, y = pixels(rng, STARS)
    mag = 18.0 - 6.0 * (1 - np.sqrt(rng.uniform(size=STARS)))
    shift = 0.004 * (mag - 14.0)[:, None] * np.array([0.0, 1.0]) * (y / fields.SIDE)[:, None]
    stars = observed(rng, x, y, true_map(x, y, None) + shift, mag=mag)
    return Truth(stars, true_map, order_config(3))


def of_kind(name: str) -> Callable[[np.random.Generator], Truth]:
    """A kind of the suite."""
    return lambda rng: KINDS[name].make(rng, KINDS[name].n)


# name, what makes it, its seeds
TRUTHS = (
    ("structure of 270 px", strong_structure, (0, 1, 2, 3)),
    ("smooth at other scales", of_kind("smooth_100"), (0,)),
    ("smooth at other scales", of_kind("smooth_500"), (1,)),
    ("phase of the pixel", pixel_phase, (0, 1)),
    ("step between amplifiers", of_kind("dead_amplifier"), (0,)),
    ("step between amplifiers", of_kind("stitching"), (1,)),
    ("tilt between exposures", tilted_exposures, (0,)),
    ("tilt between exposures", of_kind("breathing_unframed"), (1,)),
    ("shift by magnitude", magnitude_shift, (0,)),
    ("shift by magnitude", of_kind("charge_trails"), (1,)),
    ("one-sided tails", of_kind("blends"), (0, 1)),
    ("noise varies", of_kind("noise_corner"), (0,)),
    ("noise varies", of_kind("noise_bright"), (1,)),
    ("order too low", of_kind("one_order_more_10"), (0,)),
    ("order too low", of_kind("two_orders_more"), (1,)),
)
ALL = [(name, make, seed) for name, make, seeds in TRUTHS for seed in seeds]
REDUCED = [ALL[k] for k in (0, 6, 13, 15)]


@pytest.fixture(scope="module")
def every(full, tmp_path_factory) -> list[tuple[str, Steps]]:
    """All truths, or a few of them, with what was made of each."""
    folder = tmp_path_factory.mktemp("truths")

    def made() -> Iterator[tuple[str, Steps]]:
        for name, make, seed in ALL if full else REDUCED:
            truth = make(np.random.default_rng([41, seed]))
            yield f"{name} {seed}", carried(truth, folder, seed + 1)

    return list(made())


def limit_of(steps: Steps) -> bd.Requirement:
    """A limit that the truth misses."""
    return bd.Requirement("below", "p95", 0.9 * steps.true_p95())


def test_nothing_is_met_that_the_truth_misses(every, capsys):
    margins = {name: steps.margins([limit_of(steps)])[0] for name, steps in every}
    with capsys.disabled():
        print()
        for name, steps in every:
            total, margin = steps.budget().total, margins[name]
            rms = np.hypot(total.u, total.v)
            print(
                f"| {name} | {steps.true_p95():.4f} | {np.sqrt(np.mean(rms**2)):.4f} "
                f"| {margin.verdict} | {margin.probability_met:.3f} | {margin.reason} |"
            )
    assert [name for name, margin in margins.items() if margin.verdict == "met"] == []


def test_a_truth_inside_the_family_is_met(tmp_path):
    """A face that never decides would pass all other tests."""
    rng = np.random.default_rng([41, 0])
    steps = carried(of_map(rng, STARS, fields.smooth(rng, 270, 0.0)), tmp_path, 1)
    limit = bd.Requirement("above", "p95", 4.0 * steps.true_p95())
    assert steps.margins([limit])[0].verdict == "met"


def test_nothing_is_decided_without_a_look_at_the_residuals(every):
    for _, steps in every:
        for solution in (steps.posterior, steps.fit):
            asked = [limit_of(steps), bd.Requirement("far", "max", 100.0)]
            for margin in bd.check_requirements(solution, asked, rng=steps.seed, **steps.options):
                assert margin.verdict == "undecided"
                assert "the residuals were not examined" in margin.reason
