"""Artefact of the stage 'match': the stars of a run, and those that are set aside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from astropy.table import Table

from bayesdist.app.config import Config
from bayesdist.app.config.fit import HoldoutBlock
from bayesdist.app.kinds.errors import ExposureScatter
from bayesdist.app.store.output import write_table
from bayesdist.assess.terms.parameters import ScaleError
from bayesdist.data import ReferenceCatalog
from bayesdist.data.holdout import HoldoutSpec, exposures_drawn, split_matches
from bayesdist.data.matches import Matches
from bayesdist.diagnose.overlap import OverlapTest
from bayesdist.errors import InputError
from bayesdist.infer import Posterior
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.solution.solution import Solution
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.utils.arrays import Float
from bayesdist.utils.limits import HELD_OUT

MATCHING = "matching.ecsv"


@dataclass(frozen=True)
class Outline:
    """What is known of a solution before stars are matched."""

    model: DistortionModel  # without frames of exposures
    pixel: float  # size of a pixel in the unit of u and v
    filter: str = ""
    tables: tuple[LookupTable, ...] = ()  # at the nodes that the run's own will have


@dataclass(frozen=True, eq=False)
class Matched:
    """Matches of a run, in two parts, as they were read or found."""

    section: ClassVar[str] = ""  # of summary.json, that has the facts
    has_catalogue: ClassVar[bool] = True  # positions of stars come from a reference catalogue
    along_detector: ClassVar[bool] = False  # u and v are so, and not along the sky

    stars: Matches  # that are fitted
    held: Matches | None = None  # that are held out
    whole: tuple[str, ...] = ()  # exposures that are held out whole
    facts: Mapping[str, Any] = field(default_factory=dict)
    table: Table | None = None  # one row for each exposure of star lists
    catalogue: ReferenceCatalog | None = None  # where more than the matches is known

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the matching, each as a clause."""
        return tuple(self.facts.get("warnings", ()))

    @property
    def tangent_point(self) -> tuple[float, float] | None:
        """Sky position of (u, v) = (0, 0), degrees; None where u, v are not along the sky."""
        return None if self.along_detector else self.stars.tangent_point

    @property
    def mirrored(self) -> bool:
        """Boolean: u has the sign opposite to the catalogue's."""
        return self.facts.get("parity") == "mirrored"

    @property
    def filter(self) -> str:
        """The one filter of the exposures; empty where it has no name."""
        return ""

    @property
    def states_errors(self) -> bool:
        """Boolean: the catalogue has columns of errors."""
        return self.catalogue is not None and self.catalogue.sigma_u is not None

    @property
    def states_motion_errors(self) -> bool:
        """Boolean: the catalogue has columns of errors of proper motions."""
        return self.catalogue is not None and self.catalogue.sigma_pm_u is not None

    @property
    def star_errors(self) -> StarErrors | None:
        """Errors of the catalogue by code of the star; None where it has none."""
        return None

    @property
    def catalogue_name(self) -> str:
        """Name of the file of the reference catalogue, or what it is."""
        return "catalogue" if self.catalogue is None else Path(self.catalogue.source).name

    def of_order(self, order: int) -> Self:
        """Matches to be fitted by polynomials of another order."""
        return self

    def with_motions(self, table: Matches) -> Matches:
        """Matches with what the catalogue states of the motions of their stars."""
        if self.catalogue is None or table.star is None:
            return table
        names = ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v")
        motions = columns_by_code(self.catalogue, *names)
        if motions is None:
            return table
        return table.with_columns(**dict(zip(names, motions[table.star].T, strict=True)))

    def aberration(self, scatter: ExposureScatter, solution: Solution) -> ScaleError | None:
        """Error of the scale by velocity aberration, which is among the scatter; None for none."""
        return None

    def overlap(self, posterior: Posterior, tables: tuple[LookupTable, ...]) -> OverlapTest | None:
        """Two exposures far apart in time laid on each other; None where none are known so."""
        return None

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        if self.table is not None:
            write_table(self.table, folder / MATCHING)


def columns_by_code(catalog: ReferenceCatalog, *names: str) -> Float | None:
    """Columns of a catalogue by code of the star (codes, n); None where it lacks one of them."""
    out = np.zeros((int(catalog.star.max()) + 1, len(names)))
    for k, name in enumerate(names):
        values = getattr(catalog, name)
        if values is None:
            return None
        out[catalog.star, k] = values
    return out


def set_aside(
    config: Config, matches: Matches, needed: int = 0
) -> tuple[Matches, Matches | None, tuple[str, ...]]:
    """Matches that are fitted, those that are held out, and exposures that are so as a whole.

    `needed`: so many of the first exposures define the gauge and cannot be held out.
    """
    block = config.holdout
    if block is None:
        return matches, None, ()
    whole = _whole_exposures(block, config.sampler.seed, matches.exposure_names, needed)
    split = split_matches(matches, HoldoutSpec(block.fraction, whole, config.sampler.seed))
    if not HELD_OUT.met_by(len(split.held)):
        raise InputError(
            f"{len(split.held)} of {len(matches)} stars are held out, which say too little",
            where=", ".join(matches.sources),
            do=f"hold out at least {HELD_OUT.value}: raise holdout.fraction",
        )
    return split.kept, split.held, whole


def _whole_exposures(
    block: HoldoutBlock, seed: int, names: tuple[str, ...], needed: int
) -> tuple[str, ...]:
    """Exposures that are set aside whole: the named ones, or so many drawn by the seed."""
    if isinstance(block.exposures, int):
        return exposures_drawn(names[needed:], block.exposures, seed)
    for name in block.exposures:
        if name in names[:needed]:
            raise InputError(
                f"exposure {name!r} is to be held out, and defines the gauge",
                where="holdout.exposures",
                do="name another one",
            )
    return tuple(dict.fromkeys(block.exposures))
