"""Stars set aside before the fit: which ones."""

from __future__ import annotations

from bayesdist.app.config import Config
from bayesdist.data.holdout import SetAside, Split, exposures_drawn, split_matches
from bayesdist.diagnose.holdout.validation import LEAST_HELD
from bayesdist.errors import InputError
from bayesdist.infer.stars.shards import Matches

__all__ = ["split_of", "whole_exposures"]


def whole_exposures(config: Config, names: tuple[str, ...], needed: int = 0) -> tuple[str, ...]:
    """Exposures that are set aside whole: the named ones, or so many drawn by the seed.

    Parameters
    ----------
    config : Config
    names : tuple of str
        All exposures.
    needed : int
        So many of the first ones define the gauge and cannot be held out.

    Raises
    ------
    InputError
        For a named exposure that is needed.
    """
    block = config.holdout
    if block is None:
        return ()
    if isinstance(block.exposures, int):
        return exposures_drawn(names[needed:], block.exposures, config.sampler.seed)
    for name in block.exposures:
        if name in names[:needed]:
            raise InputError(
                f"exposure {name!r} is to be held out, and defines the gauge",
                where="holdout.exposures",
                do="name another one",
            )
    return tuple(dict.fromkeys(block.exposures))


def split_of(config: Config, matches: Matches, needed: int = 0) -> Split | None:
    """Matches that are fitted, and those that are set aside; None where none are.

    Parameters
    ----------
    config : Config
    matches : MatchTable or PartitionedMatches
    needed : int
        As `whole_exposures`.

    Raises
    ------
    InputError
        For an unknown exposure, and when nothing would be left, or too little set aside.
    """
    block = config.holdout
    if block is None:
        return None
    whole = whole_exposures(config, matches.exposure_names, needed)
    split = split_matches(matches, SetAside(block.fraction, whole, config.sampler.seed))
    if len(split.held) < LEAST_HELD:
        raise InputError(
            f"{len(split.held)} of {len(matches)} stars are held out, which say too little",
            where=", ".join(matches.sources),
            do=f"hold out at least {LEAST_HELD}: raise holdout.fraction",
        )
    return split
