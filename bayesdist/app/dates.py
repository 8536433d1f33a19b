"""Dates that a configuration or a requirement names, and that change nothing."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.app.config import Config
from bayesdist.assess import Requirement

__all__ = ["idle_dates"]


def idle_dates(config: Config, requirements: Sequence[Requirement], where: str = "") -> str:
    """A sentence on dates that have no effect, as nothing in the model depends on time.

    They may well document when the data are from, so that they are no error.

    Parameters
    ----------
    config : Config
    requirements : sequence of Requirement
    where : str
        File of the requirements, where it is not the configuration.

    Returns
    -------
    str
        Empty where the model depends on time, or nothing names a date.
    """
    if config.campaign is not None or config.time() is not None:
        return ""
    named = [f"of {r.where}" for r in requirements if r.epoch is not None]
    if config.assess.epoch is not None and not where:
        named.insert(0, "assess.epoch")
    if not named:
        return ""
    file = f"{where}: " if where else ""
    return (
        f"{file}nothing in the model depends on time, so that the dates given change nothing "
        f"({', '.join(named)})"
    )
