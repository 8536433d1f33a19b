"""Artefact of the stage 'match': the fitted and the held-out stars of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from astropy.table import Table

from bayesdist.app.config import Config
from bayesdist.app.config.fit import HoldoutBlock
from bayesdist.app.store.output import write_table
from bayesdist.assess.terms.parameters import ScaleError
from bayesdist.data import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.data.preparing import HoldoutSpec, exposures_drawn, split_matches
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
    """Properties of a solution that are known before stars are matched."""

    model: DistortionModel  # without the frames of exposures
    pixel: float  # size of a pixel in the unit of u and v
    filter: str = ""
    tables: tuple[LookupTable, ...] = ()  # with the nodes that the fitted tables will have


@dataclass(frozen=True, eq=False)
class Matched:
    """Matches of a run, divided into fitted and held-out stars."""

    section: ClassVar[str] = ""  # section of summary.json that holds `facts`
    has_catalogue: ClassVar[bool] = True  # star positions come from a reference catalogue
    along_detector: ClassVar[bool] = False  # u and v are along the detector axes, not along the sky

    stars: Matches  # fitted stars
    held: Matches | None = None  # held-out stars
    whole: tuple[str, ...] = ()  # exposures that are held out entirely
    facts: Mapping[str, Any] = field(default_factory=dict)
    table: Table | None = None  # one row per exposure of star lists
    catalogue: ReferenceCatalog | None = None  # None if only the matches are known

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the matching, each as a clause."""
        return tuple(self.facts.get("warnings", ()))

    @property
    def tangent_point(self) -> tuple[float, float] | None:
        """RA and Dec of (u, v) = (0, 0) in degrees; None if u, v are not along the sky."""
        return None if self.along_detector else self.stars.tangent_point

    @property
    def mirrored(self) -> bool:
        """True if u has the opposite sign to that of the catalogue."""
        return self.facts.get("parity") == "mirrored"

    @property
    def filter(self) -> str:
        """Filter of the exposures; empty if it has no name."""
        return ""

    @property
    def states_errors(self) -> bool:
        """True if the catalogue has columns of position errors."""
        return self.catalogue is not None and self.catalogue.sigma_u is not None

    @property
    def states_motion_errors(self) -> bool:
        """True if the catalogue has columns of proper-motion errors."""
        return self.catalogue is not None and self.catalogue.sigma_pm_u is not None

    @property
    def star_errors(self) -> StarErrors | None:
        """Errors of the catalogue by star code; None if there are none."""
        return None

    @property
    def catalogue_name(self) -> str:
        """File name of the reference catalogue, or 'catalogue' if it is unknown."""
        return "catalogue" if self.catalogue is None else Path(self.catalogue.source).name

    def of_order(self, order: int) -> Self:
        """Matches to be fitted by polynomials of another order."""
        return self

    def with_motions(self, table: Matches) -> Matches:
        """Matches with the proper motions and their errors from the catalogue, if it has them."""
        if self.catalogue is None or table.star is None:
            return table
        names = ("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v")
        motions = columns_by_code(self.catalogue, *names)
        if motions is None:
            return table
        return table.with_columns(**dict(zip(names, motions[table.star].T, strict=True)))

    def aberration(self, kinds: Sequence[str], tau: Float, solution: Solution) -> ScaleError | None:
        """Scale error by velocity aberration, a part of the exposure scatter; None if unknown."""
        return None

    def overlap(self, posterior: Posterior, tables: tuple[LookupTable, ...]) -> OverlapTest | None:
        """Comparison of two exposures far apart in time; None if it does not apply."""
        return None

    def save(self, folder: Path) -> None:
        """Write the matches to the folder of a run."""
        if self.table is not None:
            write_table(self.table, folder / MATCHING)


def columns_by_code(catalog: ReferenceCatalog, *names: str) -> Float | None:
    """Catalogue columns by star code (codes, n); None if the catalogue lacks any of them."""
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
    """Matches to fit, held-out matches, and the names of exposures that are held out entirely.

    Parameters
    ----------
    config : Config
        Its section [holdout] says which stars are held out; without it none are.
    matches : Matches
    needed : int
        Number of leading exposures that define the gauge and therefore cannot be held out.

    Raises
    ------
    InputError
        If too few stars would be held out, or an exposure that defines the gauge is named.
    """
    block = config.holdout
    if block is None:
        return matches, None, ()
    held_exposures = _whole_exposures(block, config.sampler.seed, matches.exposure_names, needed)
    split = split_matches(matches, HoldoutSpec(block.fraction, held_exposures, config.sampler.seed))
    if not HELD_OUT.met_by(len(split.held)):
        raise InputError(
            f"{len(split.held)} of {len(matches)} stars are held out, which say too little",
            where=", ".join(matches.sources),
            do=f"hold out at least {HELD_OUT.value}: raise holdout.fraction",
        )
    return split.kept, split.held, held_exposures


def _whole_exposures(
    block: HoldoutBlock, seed: int, names: tuple[str, ...], needed: int
) -> tuple[str, ...]:
    """Exposures to hold out entirely: those named, or a number drawn with the seed."""
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
