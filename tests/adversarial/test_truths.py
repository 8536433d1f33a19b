"""The truths are what they say they are, and the table counts as the goals are worded."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bayesdist.app.config import parse_config
from bayesdist.assess import Requirement
from bayesdist.assess.requirements.verdict import verdict_of
from tests.reduced import case_in_full, only_in_full

from . import KINDS
from .fields import SIDE, distortion, even_pixels, of_rms, smooth, tree_rings
from .goals import excused, names_cause, row_of, rows_of, table_of
from .measure import attainable, configuration, without_motion
from .truth import Truth
from .written import toml_text


def reduced(name: str) -> bool:
    """Whether the stars of a kind are looked at in the reduced form: others are made in one way."""
    return not name.startswith("selfcal") and not name.endswith("_single")


@pytest.fixture(
    scope="module",
    params=[
        k if reduced(k) else case_in_full(k, instead="other fields are drawn")
        for k in KINDS
        if not k.startswith("campaign")
    ],
)
def truth(request) -> Truth:
    return KINDS[request.param].truth(3, 200)


def test_a_seed_gives_the_same_stars_again(request, truth):
    name = request.node.callspec.params["truth"]
    again, other = KINDS[name].truth(3, 200).stars, KINDS[name].truth(4, 200).stars
    assert all(np.array_equal(again[key], column) for key, column in truth.stars.items())
    assert not np.array_equal(other["u"][:100], truth.stars["u"][:100])


def test_stars_lie_on_the_detector_where_the_map_puts_them(truth):
    stars = truth.stars
    x, y, uv = stars["x"], stars["y"], np.column_stack([stars["u"], stars["v"]])
    assert x.size >= 150
    assert min(x.min(), y.min()) >= 0.5 and max(x.max(), y.max()) <= SIDE + 0.5
    if "chip" in stars:
        below = {piece.number: piece.below for piece in truth.chips}
        y = y + [below[number] for number in stars["chip"]]
    for name, frame in truth.frames.items():
        here = stars["exposure"] == name
        uv[here] = frame.undone(uv[here])
    off = uv - truth.true_map(x, y, stars.get("epoch"))
    # most stars, whatever their errors and those of the catalogue
    assert np.median(np.abs(off)) < 0.1
    assert all(np.isfinite(column).all() for key, column in stars.items() if key != "exposure")


def test_configurations_are_read(truth):
    parsed = parse_config(toml_text(configuration(truth, seed=1)), "config.toml")
    assert parsed.model.order in (3, 5)
    assert parsed.assess.epoch == truth.epoch
    assert (parsed.model.tdd is None) == ("epoch" not in truth.stars)


def test_distortions_are_of_a_detector(rng):
    sizes = [np.abs(distortion(rng)(*even_pixels(9))).max() for _ in range(40)]
    assert 15 < np.median(sizes) < 60


@pytest.mark.slow
@only_in_full("the rms of a field is compared below")
@pytest.mark.parametrize("scale", [100, 270])
def test_random_fields_have_their_scale_and_size(scale):
    along = np.linspace(100, 1900, 60)
    products, squares = [], []
    for seed in range(40):
        field = smooth(np.random.default_rng(seed), scale, 0.004)
        here, there = field(along, along), field(along + scale, along)
        products.append((here * there).mean())
        squares.append((here**2).mean())
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.004, rel=0.06)
    assert np.mean(products) / np.mean(squares) == pytest.approx(np.exp(-0.5), abs=0.08)


def test_a_field_has_the_rms_that_is_asked_for(rng):
    values = of_rms(tree_rings(rng, 1.0), 0.003)(*even_pixels())
    assert np.sqrt(np.mean(values**2)) == pytest.approx(0.003)


def run(kind: str, verdicts: tuple[str, str, str], reason: str = "", **numbers) -> dict:
    names = ("below p95", "above p95", "below max")
    known = {"rms_error": 1.0, "rms_stated": 1.0, "within_68": 0.7, "within_95": 0.95}
    margins = [
        {"name": n, "verdict": v, "attainable": 0.7, "reason": reason}
        for n, v in zip(names, verdicts, strict=True)
    ]
    return {"kind": kind, "seed": 0, "margins": margins, "warnings": []} | known | numbers


def test_what_the_table_counts():
    good = run("inside_1500", ("missed", "met", "missed"))
    wrong = run("inside_1500", ("met", "met", "undecided"), rms_error=3.0)
    row = row_of("inside_1500", [good, wrong])
    assert (row.false_met, row.met, row.undecided) == (0.5, 1.0, 1 / 6)
    assert row.ratio == pytest.approx(np.sqrt(5))
    assert row.covers and row.decides and not row.of_right_width and not row.believable
    assert "*2.24*" in table_of([good, wrong]) and "*0.50*" in table_of([good, wrong])


def test_one_limit_that_is_falsely_met_counts_for_the_whole_truth():
    by_maximum = run("smooth_100", ("missed", "met", "met"))
    both = run("smooth_100", ("met", "met", "met"))
    open_ = run("smooth_100", ("not shown", "not shown", "not shown"))
    assert row_of("smooth_100", [by_maximum, both, open_, open_]).false_met == 0.5
    assert row_of("smooth_100", [open_]).undecided == 1.0


def test_what_does_not_cover_is_excused_by_the_right_reason_only():
    outside = {"within_68": 0.3, "within_95": 0.5}
    (row,) = rows_of([run("smooth_100", ("undecided",) * 3, **outside)])
    assert not row.honest
    (row,) = rows_of([run("smooth_100", ("undecided",) * 3, "structure is left", **outside)])
    assert row.honest
    (row,) = rows_of([run("smooth_100", ("missed", "met", "missed"), "structure", **outside)])
    assert not row.honest


def test_what_is_not_shown_is_excused_where_its_own_reason_names_the_cause():
    for reason, warned in (("too few draws", "structure is left"), ("too few draws", "")):
        one = run("smooth_100", ("missed", "not shown", "missed"), reason, warnings=[warned])
        assert not excused(one)
    assert excused(run("smooth_100", ("missed", "not shown", "missed"), "structure is left"))


def test_advice_that_helps_nothing_is_counted():
    verdicts = ("missed", "undecided", "missed")
    warned = run("merged_visits_050", verdicts, warnings=["Terms are left; raise model.order to 5"])
    right = run("merged_visits_050", verdicts, warnings=["residuals are lopsided: blends, visits"])
    assert row_of("merged_visits_050", [warned, right]).misled == 0.5
    assert row_of("merged_visits_050", [right]).right == 1.0


def test_shift_and_rotation_are_taken_off_and_nothing_else(rng):
    at = rng.uniform(-1000, 1000, (300, 2))
    left = 0.01 * at[:, :1] * at / 1000  # orthogonal to neither: taken off as well as can be
    motion = np.array([0.3, -0.2]) + 1e-4 * np.column_stack([-at[:, 1], at[:, 0]])
    assert without_motion(motion, at) == pytest.approx(0.0, abs=1e-12)
    assert without_motion(left + motion, at) == pytest.approx(without_motion(left, at), abs=1e-12)
    stretch = 1e-5 * at
    assert without_motion(stretch, at) == pytest.approx(stretch - stretch.mean(axis=0), abs=1e-4)


@pytest.mark.parametrize("factor", [1.6, 2.2])
def test_attainable_is_how_often_exact_errors_let_a_limit_be_met(rng, factor):
    draws = rng.gamma(20, 1, 4000)
    requirement = Requirement("a", "p95", 1.0)
    margin = SimpleNamespace(requirement=requirement, draws=draws, n_effective=1000.0)
    met = 0
    for actual in rng.gamma(20, 1, 500):
        fraction = np.mean(draws <= factor * actual)
        met += verdict_of(fraction, 1000.0, 0.95)[0] == "met"
    assert attainable(margin, factor) == pytest.approx(met / 500, abs=0.06)


def test_words_are_found_in_any_case():
    assert names_cause(("order",), ["Raise the ORDER."])
    assert not names_cause(("order",), ["residuals hold structure"])
