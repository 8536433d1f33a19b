"""Matches of one filter and a model of their exposures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel

__all__ = ["matches_of_filter"]


def matches_of_filter(
    matches: Matches, model: DistortionModel | Mapping[str, DistortionModel], filter: str
) -> tuple[Matches, DistortionModel]:
    """Matches of one filter, and a model with their exposures.

    A model for all filters is cut to the exposures of this one.  InputError when a dict of models
    lacks the filter, or the exposure that fixes the gauge is missing.
    """
    some = matches.select(matches.filter == matches.filter_names.index(filter))
    if not isinstance(model, DistortionModel):
        if filter not in model:
            raise InputError(
                f"there is no model for filter {filter!r}",
                do=f"models are given for {', '.join(map(repr, model))}",
            )
        one = model[filter]
        names = one.exposures if one.n_frame else some.exposure_names
    else:
        names = some.exposures
        if model.n_frame and model.gauge != "first" and names[0] != model.exposures[0]:
            raise InputError(
                f"exposure {model.exposures[0]!r}, which holds the gauge, is not in this filter",
                where=f"filter {filter}",
                do="give a model for each filter",
            )
        one = replace(model, exposures=names)
    unknown = [name for name in some.exposures if name not in names]
    if unknown:
        raise InputError(
            f"exposure {unknown[0]!r} is not in the model",
            where=f"filter {filter}",
            do="name it among the model's exposures",
        )
    code = np.array([names.index(n) if n in names else 0 for n in matches.exposure_names])
    return some.with_columns(exposure=code[some.exposure], exposure_names=names), one
