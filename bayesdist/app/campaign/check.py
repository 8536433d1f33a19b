"""What a campaign would begin with."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.app.campaign.inputs import Inputs, campaign_block, cuts_of
from bayesdist.app.campaign.soundness import (
    input_warnings,
    segment_counts,
    shear_warnings,
)
from bayesdist.app.config import Config
from bayesdist.data import StarCuts

__all__ = ["campaign_lines"]


def campaign_lines(inputs: Inputs, config: Config) -> Iterator[str]:
    """Inputs, dates and roll angles of a campaign, as lines of text."""
    log, catalog, block = inputs.log, inputs.catalog, campaign_block(config)
    epochs, rolls = log.values("epoch"), log.values("pa_v3")
    yield f"exposures    {len(log.names)} in {', '.join(log.filters)}"
    yield f"detections   {_detections(inputs, cuts_of(block))}"
    yield f"catalogue    {len(catalog)} of {inputs.n_catalog} stars, in {catalog.unit}"
    for text in (*([inputs.plane] if inputs.plane else []), *catalog.notes):
        yield f"             {text}"
    yield f"epochs       {epochs.min():.2f} to {epochs.max():.2f}"
    factors = log.values("vafactor")
    how = ", of the Earth alone" if block.vafactor_source == "earth" else ""
    yield f"VAFACTOR     {factors.min():.7f} to {factors.max():.7f}{how}"
    yield f"PA_V3        {_rolls(rolls)}"
    time = config.time()
    if time is not None:
        counts = segment_counts(epochs, time)
        yield f"segments     {', '.join(str(k) for k in counts)} exposures"
    chips = ", ".join(chip.name for chip in config.chips())
    yield f"model        order {config.model.order}, chips {chips}, tables: {config.tables.method}"
    for number, names in _without(inputs, config).items():
        yield f"chip {number}       no detections that pass the cuts in {', '.join(names)}"
    for text in [*input_warnings(config, inputs), *shear_warnings(rolls, "PA_V3")]:
        yield f"WARNING      {text[0].upper() + text[1:]}"


def _detections(inputs: Inputs, cuts: StarCuts) -> str:
    """How many there are, and how many the cuts leave."""
    total = passed = 0
    reasons: dict[str, int] = {}
    for one in inputs.lists:
        good, rejected = cuts.passed(one)
        total, passed = total + len(one), passed + int(good.sum())
        for reason, count in rejected.items():
            reasons[reason] = reasons.get(reason, 0) + count
    left = "".join(f", {count} {reason}" for reason, count in reasons.items())
    return f"{total}: {passed} pass the cuts{left}"


def _rolls(rolls: np.ndarray) -> str:
    known = rolls[np.isfinite(rolls)]
    if not len(known):
        return "not known; roll angles will be those of the matches"
    text = f"{known.min():.1f} to {known.max():.1f} degrees"
    missing = len(rolls) - len(known)
    return text + (f", not known of {missing} exposures" if missing else "")


def _without(inputs: Inputs, config: Config) -> dict[int, list[str]]:
    """Exposures that have nothing on a chip, by its number."""
    cuts = cuts_of(campaign_block(config))
    out: dict[int, list[str]] = {}
    for one in inputs.lists:
        seen = set(one.chip[cuts.passed(one)[0]].tolist())
        for chip in config.chips():
            if chip.number not in seen:
                out.setdefault(chip.number, []).append(one.name)
    return out
