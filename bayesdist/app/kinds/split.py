"""Stars set aside before the fit: which ones."""

from __future__ import annotations

from bayesdist.app.config import Config
from bayesdist.app.config.fit import HoldoutBlock
from bayesdist.data.holdout import HoldoutSpec, exposures_drawn, split_matches
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.limits import HELD_OUT

__all__ = ["set_aside"]


def set_aside(
    config: Config, matches: Matches, needed: int = 0
) -> tuple[Matches, Matches | None, tuple[str, ...]]:
    """Matches that are fitted, those that are held out, and exposures that are so as a whole.

    Parameters
    ----------
    config : Config
    matches : Matches
    needed : int
        So many of the first exposures define the gauge and cannot be held out.

    Returns
    -------
    fitted : Matches
    held : Matches or None
        None where the configuration holds nothing out.
    whole : tuple of str

    Raises
    ------
    InputError
        For an unknown exposure or one that is needed, and when nothing would be left, or too
        little set aside.
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
