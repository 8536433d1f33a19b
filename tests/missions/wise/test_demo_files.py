"""`bayesdist demo --as`: a file of each format, of a run that is made once."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.app.commands.convert import convert
from bayesdist.infer import save_fit
from bayesdist.missions.wise.simulated_pairs import FILES, SCALES
from bayesdist.products.registry import lint, read_calibration

NAMES = {
    "jwst": "jwst_niriss_nis_distortion.asdf",
    "roman": "roman_wfi_wfi01_distortion.asdf",
    "tpv": "tpv.head",
}


@pytest.fixture(scope="module")
def fit():
    import bayesdist as bd
    from bayesdist.missions.wise import simulate_wise

    matches, _ = simulate_wise(800, rng=np.random.default_rng(1))
    return bd.fit_linear(matches, bd.build_model(matches, order=4, size=(1016, 1016)))


@pytest.mark.parametrize("key", FILES)
def test_each_format_takes_the_settings_of_the_demo(fit, tmp_path, key):
    """As the demo calls it on its run: covariance and positions are those of the solution."""
    if key != "tpv":
        pytest.importorskip("asdf")
    save_fit(fit, tmp_path / "fit.nc")
    options = [f"{name}={value}" for name, value in FILES[key].items()]
    text = convert(tmp_path / "fit.nc", key, tmp_path / "file", options=options, scale=SCALES[key])
    assert "lost: " not in text
    path = tmp_path / "file" / NAMES[key]
    assert not [f for f in lint(path) if f.level == "error"]
    found = read_calibration(path)
    size = 1.0 if found.unit == "pix" else 1 / SCALES[key]
    np.testing.assert_allclose(size * found.solution.sigma, fit.sigma, rtol=1e-9)
