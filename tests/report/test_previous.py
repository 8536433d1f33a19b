"""The difference from the previous release, against a change that the test makes."""

from __future__ import annotations

import numpy as np
import pytest

import bayesdist as bd
from bayesdist.app.calibrations import difference_from_previous
from bayesdist.errors import InputError
from bayesdist.report.run_report import render_report
from bayesdist.report.sections.periods import previous_difference, previous_table

SIZE = 1000
QUADRATIC = 0.4  # pixels, of u along x at the edge, which the new calibration adds
SHIFT = 3.0  # pixels


def solution(quadratic: float, shift: float, seed: int, size: int = SIZE) -> bd.LinearFit:
    """Fit of stars whose u is x - middle + shift + quadratic X^2, with X from -1 to 1."""
    middle = (size + 1) / 2
    chip = bd.Chip(1, "camera", (size, size), (middle, middle))
    model = bd.DistortionModel(2, (chip,), "pix")
    basis = model.basis(1)
    truth = np.zeros(model.n_params)
    u = {(0, 0): shift, (1, 0): 1.0, (2, 0): quadratic * (2 / size) ** 2}
    for axis, terms in enumerate((u, {(0, 1): 1.0})):
        values = [terms.get(term, 0.0) for term in basis.terms]
        truth[model.coefficient_slice(1, axis)] = basis.from_monomials(values)
    rng = np.random.default_rng(seed)
    stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, rng=rng)
    return bd.fit_linear(stars, model)


@pytest.fixture(scope="module")
def released(tmp_path_factory):
    path = tmp_path_factory.mktemp("release") / "released.fits"
    bd.Calibration.from_solution(solution(0.0, 0.0, 1)).write("parameters", path)
    return path


def test_the_difference_is_what_was_added(converged, released):
    """Of a quadratic term a X^2 the rms over the detector about its mean is a sqrt(4 / 45)."""
    new = bd.Calibration.from_solution(solution(QUADRATIC, SHIFT, 2))
    (found,) = difference_from_previous(new, released, None)
    assert found.rms == pytest.approx(QUADRATIC * (4 / 45) ** 0.5, rel=0.02)
    assert found.similarity.shift[0] == pytest.approx(SHIFT + QUADRATIC / 3, rel=2e-3)
    assert found.differs
    run = converged.having(previous=(found,))
    (row,) = previous_table(run).rows
    assert row[-1] == "differs"
    assert float(row[1].split("\u202f")[0]) == pytest.approx(found.rms, rel=5e-3)
    assert str(released) in previous_table(run).caption
    assert len(previous_difference(run).figure.axes) == 2  # vectors, and the bar of the shades
    assert "Difference from the previous release" in render_report(run, {})


def test_the_same_sky_again_is_within_the_errors(released):
    new = bd.Calibration.from_solution(solution(0.0, SHIFT, 3))
    (found,) = difference_from_previous(new, released, None)
    assert found.differs is False


def test_without_a_release_there_is_no_section(page):
    assert "previous release" not in page


def test_a_release_of_another_detector_is_refused(released):
    new = bd.Calibration.from_solution(solution(0.0, 0.0, 3, size=600))
    with pytest.raises(InputError, match="600"):
        difference_from_previous(new, released, None)
