"""The bring-up of WSDC D-T033, section 2, from lists of stars that nobody has paired."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from scipy import stats

from bayesdist.data.detections import Detections
from bayesdist.data.matching.pairs import mutual_pairs
from bayesdist.errors import InputError
from bayesdist.missions.wise.bring_up import bring_up
from bayesdist.missions.wise.pairs.read import read_rvb
from bayesdist.missions.wise.pairs.section import RadialLimit
from bayesdist.missions.wise.simulate import wise_solution
from bayesdist.missions.wise.simulate.bringup import (
    optical_model,
    simulate_unpaired,
    write_optical_model,
)
from bayesdist.model import Chip, DistortionModel
from tests.app.support import good, refused
from tests.reduced import case_in_full

STARTS = {
    "nothing": None,
    "delivered": optical_model(turn=270)[1],
    "turned": optical_model(turn=0)[1],
}
RULE = RadialLimit(0.9, 1.3)


def vectors(theta, other=None, n=41):
    """Arrows of a model, or of its difference to another, with the constant suppressed."""
    model, _ = wise_solution("W2")
    x, y = (g.ravel() for g in np.meshgrid(*[np.linspace(1, 1016, n)] * 2))

    def positions(x, y):
        base = np.column_stack([x, y]) if other is None else model.predict(other, x, y)
        return model.predict(theta, x, y) - base

    return x, y, positions(x, y) - positions(np.array([508.5]), np.array([508.5]))


def longest(theta, other=None):
    return np.hypot(*vectors(theta, other)[2].T).max()


def test_the_optical_model_is_as_long_and_as_far_from_the_truth_as_the_printed_one():
    """Section 4: Code V rotated by 270 degrees, 3.513 px; W2 - Code V, 1.658 px."""
    _, truth = wise_solution("W2")
    _, turned = optical_model(turn=0)
    assert longest(turned) == pytest.approx(3.513, rel=0.005)
    assert longest(turned, truth) == pytest.approx(1.658, rel=0.005)


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_turning_the_delivered_model_gives_the_turned_one(turn):
    """Arrow by arrow: place and direction both turn, from x towards y."""
    x, y, delivered = vectors(optical_model(turn=turn)[1])
    c, s = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[turn]
    R = np.array([[c, -s], [s, c]])
    there = np.column_stack([x - 508.5, y - 508.5]) @ R.T + 508.5
    model, turned = optical_model(turn=0)
    centre = model.predict(turned, [508.5], [508.5]) - 508.5
    expected = model.predict(turned, *there.T) - there - centre
    np.testing.assert_allclose(delivered @ R.T, expected, atol=1e-9)


def test_only_the_right_turn_improves_on_no_model():
    """Section 2: as delivered it was worse than none; section 4: turned it is better than none."""
    _, truth = wise_solution("W2")

    def rms(theta):
        return np.sqrt((vectors(theta, truth)[2] ** 2).sum(axis=1).mean())

    none = np.sqrt((vectors(truth)[2] ** 2).sum(axis=1).mean())
    assert rms(optical_model(turn=0)[1]) < 0.8 * none
    for turn in (90, 180, 270):
        assert rms(optical_model(turn=turn)[1]) > 1.3 * none


@pytest.fixture(scope="module")
def scene():
    return simulate_unpaired(12, rng=np.random.default_rng(8), density=5e-3)


@pytest.fixture(scope="module")
def ups(scene):
    return {
        name: bring_up(scene.detections, scene.reference, scene.model, start, acceptance=RULE)
        for name, start in STARTS.items()
    }


@pytest.mark.parametrize("name", STARTS)
def test_every_start_ends_at_the_truth(scene, ups, name):
    """With all of the detector covered, and coefficients right within their errors."""
    up = ups[name]
    assert up.settled and up.rounds[-1].coverage == 1.0 and up.covered.all()
    own = scene.partner[up.index] == up.reference_index
    fit = up.fit
    d = fit.mean - scene.theta
    assert 1e-3 < stats.chi2(30).sf(d @ np.linalg.solve(fit.cov, d)) < 1 - 1e-3
    # nearly all pairs that there are, and few others
    assert own.sum() > 0.99 * (scene.partner >= 0).sum()
    assert own.mean() > 0.99
    # of all pairs, what the clipping of five sigma leaves has the errors of the lists
    sigma = np.sqrt(np.mean(up.matches.sigma_u**2))
    assert up.rounds[-1].rms == pytest.approx(sigma, rel=0.03)
    assert "converged in" in up.sentence


@pytest.mark.parametrize("name", ["nothing", "delivered"])
def test_corners_come_into_reach_round_by_round(scene, ups, name):
    """At first most pairs lie near the centre; coverage grows and never falls."""
    up = ups[name]
    coverage = [one.coverage for one in up.rounds]
    assert coverage[0] < 0.95 and coverage[-1] == 1.0
    assert (np.diff(coverage) >= 0).all()
    assert [one.order for one in up.rounds][:3] == [2, 3, 4]
    assert [one.order for one in up.rounds][-1] == 4
    # the freedom in the corners is taken back at the end
    assert up.rounds[0].acceptance == RULE
    assert up.rounds[-1].acceptance == RadialLimit(RULE.centre, RULE.centre)


def test_the_model_as_delivered_makes_it_harder_than_none(ups):
    """Section 2: a model turned by 270 degrees hid more matches than no model would have."""
    first = {name: up.rounds[0] for name, up in ups.items()}
    assert first["delivered"].n_believed < 0.8 * first["nothing"].n_believed
    assert first["delivered"].coverage < 0.8 * first["nothing"].coverage


def test_few_pairs_in_the_corners_at_first(scene):
    """With no model, in a band of the detector's corners against its centre."""
    x, y = scene.detections.x, scene.detections.y
    radius = RULE.at(x, y, (1016.0, 1016.0))
    stars, others = scene.detections, scene.reference
    index, partner, _ = mutual_pairs(
        stars.points, others.points, radius, frame=stars.exposure, reference_frame=others.exposure
    )
    true = np.zeros(len(x), bool)
    true[index] = scene.partner[index] == partner
    there = scene.partner >= 0
    r = np.hypot(x - 508.5, y - 508.5)
    inner, corner = there & (r < 200), there & (r > 600)
    assert true[inner].sum() / inner.sum() > 0.8
    assert true[corner].sum() / corner.sum() < 0.6


def test_the_number_of_false_pairs_is_foretold(scene, ups):
    """From displaced detections: the truth is within its Poisson error and a third of it."""
    for up in ups.values():
        false = (scene.partner[up.index] != up.reference_index).sum()
        expected = up.rounds[-1].n_false
        assert abs(false - expected) < 4 * np.sqrt(expected) + expected / 3


def test_mutual_pairs_in_frames_by_brute_force():
    rng = np.random.default_rng(3)
    n, m = 80, 120
    stars = Detections(*rng.uniform(0, 20, (2, n)), rng.integers(3, size=n))
    others = Detections(*rng.uniform(0, 20, (2, m)), rng.integers(3, size=m))
    radius = rng.uniform(0.5, 2.0, n)
    d = np.hypot(stars.x[:, None] - others.x, stars.y[:, None] - others.y)
    d[stars.exposure[:, None] != others.exposure] = np.inf
    near, back = d.argmin(axis=1), d.argmin(axis=0)
    expected = [(k, near[k]) for k in range(n) if back[near[k]] == k and d[k, near[k]] <= radius[k]]
    index, partner, distance = mutual_pairs(
        stars.points, others.points, radius, frame=stars.exposure, reference_frame=others.exposure
    )
    np.testing.assert_allclose(distance, d[index, partner])
    assert len(expected) > 20
    assert sorted(zip(index, partner, strict=True)) == expected


def test_acceptance_is_that_of_the_centre_and_of_the_corners():
    rule = RadialLimit(0.5, 2.0)
    x, y = np.array([508.5, 0.5, 1016.5]), np.array([508.5, 1016.5, 508.5])
    # halfway between the two where half the squared radius of a corner is reached
    np.testing.assert_allclose(rule.at(x, y, (1016.0, 1016.0)), [0.5, 2.0, 1.25])


def test_strangers_give_no_calibration(scene):
    """Another field: the reference stars are shifted by more than any radius."""
    other = scene.reference
    wrong = replace(other, x=other.x + 15.0, y=other.y - 9.0)
    with pytest.raises(InputError, match="no part of the detector has a significant excess"):
        bring_up(scene.detections, wrong, scene.model, acceptance=RULE)


def test_what_is_not_covered_is_said():
    """A catalogue that ends before the detector does."""
    scene = simulate_unpaired(12, rng=np.random.default_rng(9))
    part = scene.reference.select(scene.reference.x < 760)
    up = bring_up(scene.detections, part, scene.model, acceptance=RULE)
    assert 0.6 < up.rounds[-1].coverage < 0.85
    assert "bins are not covered; there it is an extrapolation" in up.sentence
    assert not up.covered[:, -2:].any()


def test_an_end_before_it_settled_is_said(scene):
    up = bring_up(scene.detections, scene.reference, scene.model, acceptance=RULE, max_rounds=2)
    assert not up.settled and len(up.rounds) == 2
    assert "has NOT converged in 2 rounds" in up.sentence


def write_lists(scene, folder, end="ecsv"):
    """The two lists as files, and an optical model."""
    for name in ("detections", "reference"):
        stars = getattr(scene, name)
        table = Table({key: getattr(stars, key) for key in ("x", "y", "sigma")})
        table["frame"] = [f"{k:02d}a" for k in stars.exposure]
        table.write(folder / f"{name}.{end}")
    write_optical_model(folder / "optical.hdr")
    return folder / f"detections.{end}", folder / f"reference.{end}"


@pytest.mark.parametrize("optical", [case_in_full(False, instead="a start is read as well"), True])
def test_the_command_gives_the_pairs_of_the_function(scene, ups, tmp_path, optical):
    lists, out = write_lists(scene, tmp_path, "parquet"), tmp_path / "out"
    start = ("--optical", tmp_path / "optical.hdr") if optical else ()
    shown = good("wise", "bring-up", *lists, "-o", out, "--band", "W2", "--radius", RULE.centre,
                 "--corner-radius", RULE.corner, *start)  # fmt: skip
    up = ups["delivered" if optical else "nothing"]
    assert up.sentence in shown.out
    assert json.loads((out / "bring_up.json").read_text())["verdict"] == up.sentence
    rounds = Table.read(out / "rounds.ecsv")
    assert rounds["n_believed"].tolist() == [one.n_believed for one in up.rounds]
    found = read_rvb(out / "pairs")
    assert found.band == "W2" and len(found) == len(up.matches)
    for name in ("x", "y", "u", "v", "sigma_u"):
        np.testing.assert_array_equal(getattr(found.matches, name), getattr(up.matches, name))


def test_lists_without_errors_are_refused(tmp_path):
    few = simulate_unpaired(2, rng=np.random.default_rng(8), density=2e-4)
    detections, reference = write_lists(few, tmp_path)
    table = Table.read(detections)
    table.remove_column("sigma")
    table.write(detections, overwrite=True)
    refused(tmp_path, "wise", "bring-up", detections, reference, "-o", tmp_path / "out", "--band",
            "W2", words=["detections.ecsv", "no column 'sigma'"])  # fmt: skip


def test_wrong_requests_are_refused(scene):
    with pytest.raises(InputError, match="start has shape"):
        bring_up(scene.detections, scene.reference, scene.model, np.zeros(3), acceptance=RULE)
    far = Detections(np.array([5.0, 1030.0]), np.ones(2), sigma=np.ones(2))
    with pytest.raises(InputError, match=r"detection 2 is at pixel \(1030.00, 1.00\)"):
        bring_up(far, scene.reference, scene.model, acceptance=RULE)
    two = (Chip(1, "a", (9.0, 9.0), (5.0, 5.0)), Chip(2, "b", (9.0, 9.0), (5.0, 5.0)))
    with pytest.raises(InputError, match="one chip"):
        bring_up(scene.detections, scene.reference, DistortionModel(4, two), acceptance=RULE)
    with pytest.raises(InputError, match="rotated by 45"):
        optical_model(turn=45)
    with pytest.raises(InputError, match="row 2, column 'sigma'"):
        Detections(np.ones(2), np.ones(2), sigma=np.array([1.0, 0.0]))
    with pytest.raises(InputError, match="has no errors"):
        bring_up(replace(far, sigma=None), scene.reference, scene.model, acceptance=RULE)
    with pytest.raises(InputError, match="fraction of common stars"):
        simulate_unpaired(1, rng=np.random.default_rng(1), common=1.5)
