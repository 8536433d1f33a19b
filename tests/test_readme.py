"""The whole job in Python, as the README shows it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import bayesdist as bd
from bayesdist.formats import read_sip, sip_from_solution, write_sip
from bayesdist.missions.wise import simulate_wise
from bayesdist.model import PolynomialBasis
from bayesdist.simulate import camera, matched_to_gaia
from tests.app.support import as_table

from .docs_blocks import blocks

README = Path(__file__).resolve().parents[1] / "README.md"


def test_the_session_of_the_readme(tmp_path, monkeypatch):
    rng = np.random.default_rng(1)
    simulated, truth = simulate_wise(1500, rng=rng)
    as_table(simulated).write(tmp_path / "stars.ecsv")
    monkeypatch.chdir(tmp_path)

    matches = bd.read_matches("stars.ecsv")
    model = bd.build_model(matches, order=4, size=(1016, 1016))
    fit = bd.fit_linear(matches, model)
    posterior = bd.sample(fit, matches, seed=1, folder=".")
    bd.save_posterior(posterior, matches, "posterior.nc")
    again = bd.load_posterior("posterior.nc")
    errors = bd.uncertainty_map(again, grid=(17, 17))
    catalogue = bd.UserTerm("catalogue", "systematic", 0.005, 0.005)
    budget = bd.error_budget(again, terms=[catalogue], rng=rng)
    goal = bd.Requirement("field-wide", "p95", 0.1)
    (margin,) = bd.check_requirements(again, [goal], terms=[catalogue], rng=rng)
    write_sip(sip_from_solution(again, linear="sip"), "sip.hdr")

    assert posterior.convergence.converged
    off = again.mean - truth.theta
    assert off @ np.linalg.solve(again.cov, off) < 60  # 30 degrees of freedom, p = 1e-3
    assert again.sigma == pytest.approx(posterior.sigma)
    assert errors.sigma_u.shape == (17, 17) and 0 < errors.sigma_u_max < 0.1
    names = [row["name"] for row in budget.rows()]
    assert names == ["coefficients", "catalogue", "total"]
    # nothing is decided before the residuals are examined
    assert margin.verdict == "undecided" and 0 < margin.value < 0.1
    assert margin.reason.startswith("the residuals were not examined; give diagnostics=")
    header = read_sip("sip.hdr")
    assert header.order == (4, 4)
    write_sip(header, "again.hdr")
    assert (tmp_path / "again.hdr").read_text() == (tmp_path / "sip.hdr").read_text()


def test_the_sip_terms_are_those_that_were_published(tmp_path):
    """From simulated pairs back to Appendix B of the WISE report, within the errors stated."""
    from bayesdist.missions.wise.published import WISE_COEFFICIENTS

    matches, _ = simulate_wise(3000, rng=np.random.default_rng(2))
    fit = bd.fit_linear(matches, bd.build_model(matches, order=4, size=(1016, 1016)))
    header = sip_from_solution(fit, linear="sip")
    terms = PolynomialBasis(4, (1016, 1016), (508.5, 508.5)).terms
    for found, sigma, published in (
        (header.a, header.sigma_a, WISE_COEFFICIENTS["W2"][0]),
        (header.b, header.sigma_b, WISE_COEFFICIENTS["W2"][1]),
    ):
        # jitter makes the formal errors too small by the square root of chi-square per degree
        stretch = np.sqrt(fit.chi2 / fit.dof)
        pull = [
            (found[t] - value) / (stretch * sigma[t])
            for t, value in zip(terms, published, strict=True)
        ]
        assert np.abs(pull).max() < 4.5


def test_everything_that_is_public_is_there():
    for name in bd.__all__:
        assert getattr(bd, name) is not None
    with pytest.raises(AttributeError, match="no_such_thing"):
        bd.no_such_thing  # noqa: B018
    assert set(bd.__all__) <= set(dir(bd))


def test_run_is_the_command_as_a_function(tmp_path):
    from bayesdist.errors import BayesdistError

    with pytest.raises(BayesdistError, match=r"none\.toml"):
        bd.run(tmp_path / "none.toml", tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_two_catalogues_become_matches_as_the_readme_says(tmp_path, monkeypatch):
    """The header's own WCS has no distortion, so that stars are seen 0.4 arcsec off at most.

    A match of one star with another has magnitudes that differ; those of one star do by 0.02.
    """
    rng, n = np.random.default_rng(3), 300
    table = matched_to_gaia(n, rng)
    plane = camera()
    plane.sip, plane.wcs.ctype = None, ["RA---TAN", "DEC--TAN"]
    sky = plane.pixel_to_world(table["XWIN_IMAGE"] - 1, table["YWIN_IMAGE"] - 1)
    seen = table["XWIN_IMAGE", "YWIN_IMAGE", "MAG_AUTO"]
    seen["ALPHA_J2000"], seen["DELTA_J2000"] = sky.ra.degree, sky.dec.degree
    monkeypatch.chdir(tmp_path)
    heads = [f"# {k:3} {name:20} text" for k, name in enumerate(seen.colnames, 1)]
    rows = [" ".join(f"{value:.8f}" for value in row) for row in seen]
    (tmp_path / "exposure.cat").write_text("\n".join([*heads, *rows]) + "\n")
    gaia = table[[name for name in table.colnames if name not in seen.colnames]]
    gaia[rng.permutation(n)].write("gaia.csv")

    [block] = [text for _, text in blocks(README) if "match_to_catalog_sky" in text]
    exec(compile(block, "README.md", "exec"), {})
    matched = Table.read("stars.csv")
    assert len(matched) > 0.95 * n
    same = np.abs(matched["MAG_AUTO"] - matched["phot_g_mean_mag"]) < 0.1
    assert np.mean(same) > 0.97
    found = bd.read_matches("stars.csv", sigma=0.01, epoch=2024.3)
    assert len(found) == len(matched) and found.unit == "arcsec"
