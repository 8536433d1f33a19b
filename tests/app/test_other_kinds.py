"""A kind of run from a package that bayesdist does not know: spots of a mask on a detector."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from lxml import html

from .support import CENTRE, REPOSITORY, SIZE, config_text, model_of, truth_of

CONFIG = '''
"""[spots]: a text file of spots, and how well the scale of the mask is known."""

from typing import ClassVar

from bayesdist.app.config import StarsConfig
from bayesdist.app.config.section import Section


class SpotsBlock(Section):
    file: str
    sigma: float
    scale_sigma: float


class SpotsConfig(StarsConfig):
    kind: ClassVar[str] = "spots.kind:SPOTS"
    title: ClassVar[str] = "spots of a mask"
    begins_with: ClassVar[str] = "fit"

    spots: SpotsBlock

    def named_files(self, base):
        return [base / self.spots.file]
'''
KIND = '''
"""Spots of a mask: their places are those of the mask, whose scale has an error."""

from dataclasses import dataclass

import numpy as np

from bayesdist.app.kind import RunKind
from bayesdist.app.stars import set_aside
from bayesdist.app.parts import Part
from bayesdist.assess.terms.parameters import ScaleError
from bayesdist.data import Matches
from bayesdist.infer import GaussianPriors, build_model, fit_linear
from bayesdist.report.run import Terminology
from bayesdist.utils.checks import Check


@dataclass(frozen=True)
class Mask(Part):
    title = "mask"
    recorded = True

    scale_sigma: float


class SpotsKind(RunKind):
    has_catalogue = False
    words = Terminology(rows="spots", all_rows="spots", false_rows="false spots")

    def read(self, config, base):
        x, y, u, v = np.loadtxt(base / config.spots.file).T
        sigma = np.full(len(x), config.spots.sigma)
        return Matches(x, y, u, v, sigma_u=sigma, sigma_v=sigma, unit="pix")

    def match(self, run):
        stars, held, exposures = set_aside(run.config, run.inputs)
        return run.having(
            stars=stars,
            held_stars=held,
            held_exposures=exposures,
            match_facts={"scale_sigma": run.config.spots.scale_sigma},
        )

    def fit(self, run):
        config = run.config
        model = build_model(
            run.stars,
            order=config.model.order,
            size=config.detector.size,
            reference_pixel=config.model.reference_pixel,
        )
        return run.having(
            fit=fit_linear(run.reader.shards(model, run.stars), model),
            priors=GaussianPriors.none(model),
            parts={"mask": Mask(run.match_facts["scale_sigma"])},
        )

    def error_terms(self, run, solution):
        sigma = run.part(Mask).scale_sigma
        term = ScaleError("expansion of the mask", "scale", sigma, solution, "given by the user")
        return [term, *super().error_terms(run, solution)]

    def checks(self, run):
        return (Check("Mask", "Scale of the mask", str(run.part(Mask).scale_sigma)),)

SPOTS = SpotsKind()
'''
SCALE_SIGMA = 1e-4


def _installed(folder: Path) -> None:
    """A package with the kind, as an installer leaves it."""
    package, metadata = folder / "spots", folder / "spots-1.0.dist-info"
    for path in (package, metadata):
        path.mkdir()
    (package / "__init__.py").write_text(
        "from bayesdist.plugin import Plugin\n"
        'PLUGIN = Plugin(kinds={"spots": "spots.config:SpotsConfig"})\n'
    )
    (package / "config.py").write_text(CONFIG)
    (package / "kind.py").write_text(KIND)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: spots\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[bayesdist.plugins]\nspots = spots:PLUGIN\n")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of the kind, whose stage 'evaluate' was made again from its folder."""
    folder = tmp_path_factory.mktemp("spots")
    _installed(folder)
    rng, model = np.random.default_rng(2), model_of()
    x, y = (rng.uniform(0.5, n + 0.5, 400) for n in SIZE)
    u, v = model.predict(truth_of(model), x, y).T
    noise = 0.02 * rng.standard_normal((2, 400))
    np.savetxt(folder / "spots.txt", np.column_stack([x, y, u + noise[0], v + noise[1]]))
    spots = {"file": "spots.txt", "sigma": 0.02, "scale_sigma": SCALE_SIGMA}
    text = config_text(data=None, spots=spots)
    (folder / "config.toml").write_text(text)
    commands = """
import sys
from tests.sketches import main
for words in (["run", "config.toml", "-o", "run", "-q"], ["stage", "evaluate", "run"]):
    sys.argv[1:] = words
    assert main() == 0
"""
    path = os.pathsep.join([str(folder), str(REPOSITORY)])
    done = subprocess.run(
        [sys.executable, "-c", commands], cwd=folder, env={**os.environ, "PYTHONPATH": path},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "run"


def test_a_kind_of_another_package_is_run_and_continued(run):
    summary = json.loads((run / "summary.json").read_text())
    assert summary["kind"] == "spots" and summary["data"]["n_rows"] == 400


def test_it_is_found_even_if_it_is_imported_first(run):
    """Its module imports the configurations of bayesdist, which must not ask for it too early."""
    code = "import spots.kind; from bayesdist.app.config import installed_kinds as kinds; "
    code += "print(*kinds())"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env={**os.environ, "PYTHONPATH": str(run.parent)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["data", "campaign", "selfcal", "spots"], done.stderr


def test_its_error_term_is_in_the_budget(run):
    """A relative error of the scale moves a position by its distance from the reference pixel."""
    budget = Table.read(run / "budget.ecsv")
    [row] = [row for row in budget if row["name"] == "expansion of the mask"]
    nx, ny = 9, 7  # positions of the budget, from edge to edge
    for axis, size, n, centre in zip("uv", SIZE, (nx, ny), CENTRE, strict=True):
        places = np.linspace(1, size, n) - centre
        expected = SCALE_SIGMA * np.sqrt(np.mean(places**2))
        assert row[axis] == pytest.approx(expected, rel=0.1)


def test_its_words_and_checks_are_in_the_report(run):
    page = html.fromstring((run / "report.html").read_bytes())
    text = "".join(page.xpath("//body//text()[not(ancestor::script or ancestor::style)]"))
    assert "Scale of the mask" in text and "spots" in text and "false spots" in text
    assert "matched stars" not in text and "reference catalogue" not in text
