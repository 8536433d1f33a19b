"""Draws of an error model at some pixels, row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.model import error_model

JOINT = "model"


@dataclass
class DrawnFields:
    """What the tests ask of fields: draws and sigmas of each row, and of all together."""

    drawn: DrawnErrors
    domain: EvaluationDomain

    @property
    def parts(self):
        return (*(row.name for field in self.drawn.at(self.domain) for row in field.rows), JOINT)

    def field(self, name, draws=None):
        draws = draws or slice(0, self.drawn.n_draws)
        fields = self.drawn.at(self.domain)
        if name == JOINT:
            return self.drawn.errors(self.domain)(draws, np.zeros(1))
        [one] = [
            part
            for field in fields
            for part in field.parts
            if name in [row.name for row in part.rows]
        ]
        return one.errors(draws, {})

    def sigma(self, name):
        fields = self.drawn.at(self.domain)
        if name == JOINT:
            return np.sqrt(sum(one.total() for one in fields)).T
        [square] = [one.squares()[name] for one in fields if name in one.squares()]
        return np.sqrt(square).T


def fields_at(drawn, x, y, *, chip=None, epoch=None) -> DrawnFields:
    """Of draws that serve several chips and epochs."""
    model = drawn.solution.model
    number = model.chips[0].number if chip is None else chip
    return DrawnFields(drawn, EvaluationDomain.at_pixels(model, number, x, y, epoch=epoch))


def drawn_fields(
    solution, x, y, *, terms=(), aligned=False, epoch=None, chip=None, n_draws=1000, rng
) -> DrawnFields:
    drawn = error_model(solution, terms=terms, aligned=aligned, pixel_scale=1.0).drawn(n_draws, rng)
    return fields_at(drawn, x, y, chip=chip, epoch=epoch)
