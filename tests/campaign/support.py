"""One simulated campaign, calibrated as `bayesdist run` does it, with the truth beside it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from bayesdist.app.config import load_config
from bayesdist.app.run import Run
from bayesdist.app.stages import make_stages
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.infer.catalogue.star_covariance import star_covariance
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.exposures.hierarchy import HierarchicalFit
from bayesdist.infer.nodes import Matern, NodeGrid, TableFit
from bayesdist.infer.solution.solution import TransformedSolution
from bayesdist.kinds.campaign import fit as stage
from bayesdist.kinds.campaign.matching import affine_model_of
from bayesdist.kinds.campaign.series import Series
from bayesdist.missions.hst.simulate import AcsCampaign, acs_model, read_acs
from bayesdist.missions.hst.simulate.truth import OWN
from bayesdist.model import DistortionModel, LookupTable
from tests.app.support import good
from tests.infer.small_campaign import with_star_errors

FILTER = "F606W"
TERMS = ("A_2", "B_3", "B_2")  # Tables 1, 2, 3
CHIPS = (1, 2)
SEGMENTS = (0, 1)
# ACS ISR 2015-06, Tables 1 to 3: alpha, its sigma, beta, its sigma; [term][chip][before, after SM4]
PUBLISHED = np.array(
    [
        [
            [(0.98205648, 9.14e-7, -9.22e-6, 6.85e-7), (0.98196909, 1.45e-6, -2.18e-5, 8.40e-7)],
            [(0.99468101, 8.65e-7, -9.16e-6, 6.47e-7), (0.99459657, 1.36e-6, -2.26e-5, 7.86e-7)],
        ],
        [
            [(0.97263238, 1.25e-6, 2.42e-6, 9.37e-7), (0.97263233, 1.41e-6, -1.12e-6, 8.17e-7)],
            [(1.00622300, 1.29e-6, 3.30e-6, 9.65e-7), (1.00621870, 1.13e-6, -8.04e-7, 6.52e-7)],
        ],
        [
            [
                (0.080947069, 9.206e-7, 3.617e-5, 6.893e-7),
                (0.081139194, 2.450e-6, 3.235e-5, 1.418e-6),
            ],
            [
                (0.068598586, 9.211e-7, 3.532e-5, 6.897e-7),
                (0.068779336, 2.255e-6, 3.070e-5, 1.305e-6),
            ],
        ],
    ]
)
TRUE_LINES, PUBLISHED_SIGMA = PUBLISHED[..., ::2], PUBLISHED[..., 1::2]  # (3, 2, 2, alpha and beta)

# a pattern that the field is the right model of, the simulation's at twice its size: a seed of it
# takes seconds
WIDE = 128.0
FIELD = {1: Matern(0.05, 400.0, 1.5), 2: Matern(0.025, 400.0, 1.5)}


@dataclass(frozen=True)
class Setting:
    """Which campaign is simulated.

    Parameters
    ----------
    pattern : str
        'isr': that of `bayesdist simulate acs`, at nodes 64 pixels apart; 'matern': a random field
        at nodes 128 pixels apart; 'none'.
    step : float
        Pixels between the nodes that are fitted.
    exposures, stars : int
    own : float
        How much the linear terms of WFC1 scatter by themselves, beside what both chips share.
    """

    pattern: str
    step: float
    exposures: int = 36
    stars: int = 20_000
    own: float = OWN


MATERN = Setting("matern", WIDE)
ISR = Setting("isr", 64.0)
PUBLISHED_SIZE = Setting("matern", WIDE, 110, 53_900)
# a chip that is as restless by itself as both are together: its gap to the other is no ruler
LOOSE = Setting("none", WIDE, own=1.0)
# what a reduced suite makes of it: as many lines and nodes, from fewer exposures and stars
SHORT = {MATERN: replace(MATERN, exposures=20, stars=7000)}


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What the stages 'match' and 'fit' made of one campaign.

    Parameters
    ----------
    campaign : AcsCampaign
        What it was made from.
    run : Run
    tables : TableFit or None
    bare, joint : HierarchicalFit and TransformedSolution
        All exposures jointly; without and with the correlated errors of the catalogue.
    terms : Series
        Linear terms of every exposure alone.
    """

    campaign: AcsCampaign
    run: Run
    tables: TableFit | None
    bare: HierarchicalFit
    joint: TransformedSolution
    terms: Series

    @property
    def affine_model(self) -> DistortionModel:
        """Configured polynomial with a free linear part for each exposure."""
        return affine_model_of(self.run.inputs.config, self.run.stars)


@contextmanager
def calibrated(setting: Setting, seed: int) -> Iterator[Calibrated]:
    """Simulate a campaign and calibrate it.

    Its files are gone afterwards, and with them what has not yet been read.
    """
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "campaign"
        _simulate(setting, seed, base)
        config = base / f"campaign_{FILTER.lower()}.toml"
        settings, text = load_config(config)
        directory = RunDirectory.plan(Path(folder) / "run", settings, text, base)
        directory.begin()
        with Run.of(directory) as run:
            run = make_stages(run, ("match",))
            with _results_of("fit_tables", "fit_hierarchical") as made:
                run = make_stages(run, ("fit",))
            bare = made["fit_hierarchical"]
            yield Calibrated(
                campaign=read_acs(base),
                run=run,
                tables=made["fit_tables"][1],
                bare=bare,
                joint=_with_catalogue(bare, run),
                terms=run.parts["alone"].series,
            )


def _simulate(setting: Setting, seed: int, folder: Path) -> None:
    with ExitStack() as stack:
        simulate = "bayesdist.missions.hst.simulate"
        if setting.pattern == "matern":
            making = f"{simulate}.making."
            stack.enter_context(mock.patch(making + "detector_tables", _random_field))
            stack.enter_context(mock.patch(making + "filter_tables", return_value=()))
        stack.enter_context(mock.patch(f"{simulate}.truth.OWN", setting.own))
        options = ["--exposures", setting.exposures, "--stars", setting.stars, "--seed", seed]
        options += ["--no-tables"] if setting.pattern == "none" else []
        good("simulate", "acs", "-o", folder, *options, "-q")
    config = folder / f"campaign_{FILTER.lower()}.toml"
    text = config.read_text(encoding="utf-8")
    changed = text.replace("[tables]\n", f"[tables]\nstep = [{setting.step}, {setting.step}]\n")
    assert changed != text
    if setting.pattern == "none":
        changed = changed.replace('method = "field"', 'method = "none"')
    config.write_text(changed, encoding="utf-8")


def grids(step: float) -> dict[int, NodeGrid]:
    """Nodes of the tables of each chip."""
    return {chip.number: NodeGrid(chip, 5, (step, step)) for chip in acs_model().chips}


def _random_field(rng: np.random.Generator) -> tuple[LookupTable, ...]:
    """Tables drawn from the very prior that the fit has, hyperparameters apart."""
    out = []
    for number, grid in grids(WIDE).items():
        root = np.linalg.cholesky(FIELD[number].covariance(grid))
        values = grid.without_polynomials(root @ rng.standard_normal((grid.n_nodes, 2)))
        out.append(grid.table(values.T))
    return tuple(out)


@contextmanager
def _results_of(*names: str) -> Iterator[dict[str, Any]]:
    """Results of functions that the stage 'fit' calls."""
    made: dict[str, Any] = {}

    def kept(name: str) -> Callable[..., Any]:
        function = getattr(stage, name)

        def call(*args: Any, **options: Any) -> Any:
            made[name] = function(*args, **options)
            return made[name]

        return call

    with ExitStack() as stack:
        for name in names:
            stack.enter_context(mock.patch.object(stage, name, kept(name)))
        yield made


def _with_catalogue(bare: HierarchicalFit, run: Run) -> TransformedSolution:
    """The joint fit with the errors that a star of the catalogue has in all exposures."""
    catalog, matches = run.catalogue, run.matches

    def by_code(values: Any) -> np.ndarray:
        out = np.zeros(int(catalog.star.max()) + 1)
        out[catalog.star] = values
        return out

    position, motion = (
        np.stack([by_code(getattr(catalog, f"{name}_{axis}")) for axis in "uv"], axis=1)
        for name in ("sigma", "sigma_pm")
    )
    errors = StarErrors(position, motion, by_code(catalog.epoch))
    stars = star_covariance(bare, matches, errors)
    return with_star_errors(bare, stars)
