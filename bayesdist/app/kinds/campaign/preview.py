"""Lines of `bayesdist check` on the inputs of a campaign."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.app.kinds.campaign.input_validation import (
    input_warnings,
    segment_counts,
    shear_warnings,
)
from bayesdist.app.kinds.campaign.inputs import Inputs


def campaign_lines(inputs: Inputs) -> Iterator[str]:
    """Inputs, dates and roll angles of a campaign, as lines of text."""
    config, log, catalog, lists = inputs.config, inputs.log, inputs.catalog, inputs.star_lists
    epochs, rolls = log.values("epoch"), log.values("pa_v3")
    yield f"exposures    {len(log.names)} in {', '.join(log.filters)}"
    passed, left = sum(int(good.sum()) for good in lists.passed), lists.cut_words
    yield f"detections   {len(lists)}: {passed} pass the cuts" + (f", {left}" if left else "")
    yield f"catalogue    {len(catalog)} of {len(inputs.whole_catalog)} stars, in {catalog.unit}"
    for text in (*([inputs.plane] if inputs.plane else []), *catalog.notes):
        yield f"             {text}"
    yield f"epochs       {epochs.min():.2f} to {epochs.max():.2f}"
    factors = log.values("vafactor")
    how = ", of the Earth alone" if config.campaign.vafactor_source == "earth" else ""
    yield f"VAFACTOR     {factors.min():.7f} to {factors.max():.7f}{how}"
    yield f"PA_V3        {_rolls(rolls)}"
    time = config.time()
    if time is not None:
        counts = segment_counts(epochs, time)
        yield f"segments     {', '.join(str(k) for k in counts)} exposures"
    chips = ", ".join(chip.name for chip in config.chips())
    yield f"model        order {config.model.order}, chips {chips}, tables: {config.tables.method}"
    for number, names in _without(inputs).items():
        yield f"chip {number}       no detections that pass the cuts in {', '.join(names)}"
    warnings, unknown = input_warnings(inputs), np.count_nonzero(np.isnan(rolls))
    if 0 < unknown < len(rolls):
        warnings.append(f"PA_V3 is missing of {unknown} of {len(rolls)} exposures")
    for text in (*warnings, *shear_warnings(rolls, "PA_V3")):
        yield f"WARNING      {text[0].upper() + text[1:]}"


def _rolls(rolls: np.ndarray) -> str:
    known = rolls[np.isfinite(rolls)]
    if not len(known):
        return "not known; roll angles will be those of the matches"
    return f"{known.min():.1f} to {known.max():.1f} degrees"


def _without(inputs: Inputs) -> dict[int, list[str]]:
    """Exposures that have nothing on a chip, by its number."""
    lists, out = inputs.star_lists, dict[int, list[str]]()
    for name, one, good in zip(lists.names, lists.lists, lists.passed, strict=True):
        for chip in inputs.config.chips():
            if chip.number not in one.chip[good]:
                out.setdefault(chip.number, []).append(name)
    return out
