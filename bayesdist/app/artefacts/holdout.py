"""Division of matches into those that are fitted and those that are held out."""

from __future__ import annotations

from bayesdist.app.config import Config
from bayesdist.app.config.fit import HoldoutBlock
from bayesdist.data.matches import Matches
from bayesdist.data.preparing import HoldoutSpec, exposures_drawn, split_matches
from bayesdist.errors import InputError
from bayesdist.utils.limits import HELD_OUT


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
