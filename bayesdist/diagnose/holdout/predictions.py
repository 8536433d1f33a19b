"""Positions of stars that a model predicts, and how they follow its parameters: group by group."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.diagnose.holdout.predictive import Predictive
from bayesdist.infer.stars.stars import errors_of
from bayesdist.model import DistortionModel, Groups

__all__ = ["Prediction", "groups_of", "noise_of", "predictions"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

AT_ONCE = 2**14  # stars


@dataclass(frozen=True, eq=False)
class Prediction:
    """Stars of one group, or some of them, against a model."""

    index: Int  # rows (n,) of their table
    residual: Float  # data minus prediction (n, 2)
    columns: Int  # parameters (m,) that the prediction depends on
    jacobian: Float  # derivatives (n, 2, m) of the prediction by these
    frame: Float  # linear part (2, 2) of the exposure's frame


def predictions(
    model: DistortionModel, theta: Float, table: Matches, rows: Int, exposure: Int | int | None
) -> Iterator[Prediction]:
    """Iterator over some rows (n,) of a table, by chip, date and code of the exposure."""
    groups = groups_of(model, table, rows, exposure)
    effective = model.effective(theta, groups)
    jacobians = model.effective_jacobian(theta, groups)
    data = np.stack([table.u, table.v], axis=1)
    for g, members in enumerate(groups.members()):
        columns, d = jacobians[g]
        basis = model.basis(model.chips[groups.chip[g]].number)
        frame = np.asarray(model.frame(theta, int(groups.exposure[g]))[0])
        for start in range(0, len(members), AT_ONCE):
            index = rows[members[start : start + AT_ONCE]]
            phi = basis.evaluate(table.x[index], table.y[index])
            jacobian = np.einsum("nk,akm->nam", phi, d)
            yield Prediction(index, data[index] - phi @ effective[g].T, columns, jacobian, frame)


def groups_of(
    model: DistortionModel, table: Matches, rows: Int, exposure: Int | int | None
) -> Groups:
    """Groups of some rows (n,) of a table, of exposures with these codes."""
    return model.groups(
        len(rows),
        epoch=None if table.epoch is None else table.epoch[rows],
        exposure=exposure,
        chip=table.chip_number[rows],
    )


def noise_of(predictive: Predictive, table: Matches, index: Int) -> Float:
    """uu, vv and uv (n, 3) of the errors of stars without those of the solution's parameters."""
    var = np.stack(errors_of(table), axis=1)[index] ** 2 + predictive.jitter2
    if predictive.local and not predictive.local_in_noise:
        place = (table.x[index], table.y[index], table.chip_number[index])
        var = var + predictive.local_variance(*place)[:, None]
    return np.column_stack([var, np.zeros(len(var))])
