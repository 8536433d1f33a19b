"""What a solution says of itself at a prompt: a line that can be read, not its covariance."""

from __future__ import annotations

import numpy as np

from bayesdist.infer import fit_linear, sample
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches

SIZE = (1000.0, 800.0)


def test_solutions_say_what_they_are_in_a_line() -> None:
    model = DistortionModel(2, (Chip(1, "WFC1", SIZE, (500.5, 400.5)),))
    theta = np.zeros(model.n_params)
    matches, _ = simulate_matches(
        model, theta, 200, rng=np.random.default_rng(2), sigma=0.02, outlier_scale=0.5
    )
    fit = fit_linear(matches, model)
    text = repr(fit)
    for part in ("order 2", "1 chip (WFC1)", "12 parameters", f"{fit.n_used} of 200 stars",
                 f"chi2/dof {fit.chi2:.5g}/{fit.dof}"):  # fmt: skip
        assert part in text
    posterior = sample(fit, matches)
    said = repr(posterior)
    for part in ("order 2", "200 stars", "converged", "R-hat", f"{len(posterior.flat)} draws"):
        assert part in said
    for line in (text, said):
        assert "\n" not in line and len(line) < 250 and "array" not in line
