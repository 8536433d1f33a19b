"""Independent fits of all exposures in the reference gauge, and their linear terms against time.

The method is that of Kozhurina-Platais et al. (2015, sections 4.2 and 4.4).  All chips of an
exposure are fitted in the system of the catalogue, and the solution is rotated and shifted to the
reference chip.  The linear terms of all exposures, with their covariances, form a time series.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, Rejection, fit_linear
from bayesdist.infer.solution.solution import TransformedSolution
from bayesdist.infer.solution.transforms import (
    LinearTerms,
    bare_model,
    linear_terms,
    reference_gauge,
)
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class ExposureSolutions:
    """Time series of the solutions of single exposures.

    Parameters
    ----------
    names : tuple of str, length E
        Names of the exposures that were fitted.
    epoch : ndarray, shape (E,)
        Dates of the exposures in decimal years.
    labels : tuple of str, length k
        Labels of the linear terms; see `LinearTerms`.
    values : ndarray, shape (E, k)
        Linear terms in the reference gauge. A_1, B_1 and A_3 of the reference chip are zero and
        have no error.
    cov : ndarray, shape (E, k, k)
        Formal covariance of the linear terms.
    views : tuple of TransformedSolution
        Solution of each exposure in the reference gauge.
    skipped : dict of str to str
        Reasons why exposures were left out, by name.
    """

    names: tuple[str, ...]
    epoch: Float
    labels: tuple[str, ...]
    values: Float
    cov: Float
    views: tuple[TransformedSolution, ...]
    skipped: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.names)

    def series(self, *labels: str) -> tuple[Float, Float, Float]:
        """Selected linear terms against time.

        Parameters
        ----------
        *labels : str
            Labels of k terms.

        Returns
        -------
        epoch : ndarray, shape (E,)
            Decimal years.
        values : ndarray, shape (E, k)
        cov : ndarray, shape (E, k, k)

        Raises
        ------
        InputError
            If a label is unknown.
        """
        exposures = zip(self.values, self.cov, strict=True)
        selected = [LinearTerms(self.labels, v, c).select(*labels) for v, c in exposures]
        return (
            self.epoch,
            np.array([t.values for t in selected]),
            np.array([t.cov for t in selected]),
        )


@one_thread
def fit_exposures(
    matches: Matches,
    model: DistortionModel,
    *,
    chip: int = 2,
    rejection: Rejection = DEFAULT_REJECTION,
) -> ExposureSolutions:
    """Fit every exposure independently.

    Exposures that cannot be fitted are left out and listed in the result.

    Parameters
    ----------
    matches : Matches
        Stars with errors and epochs.
    model : DistortionModel
        Model of each exposure; its frames and time dependence are ignored.
    chip : int
        Number of the reference chip.
    rejection : Rejection
        Rejection limits and weights; see `fit_linear`.

    Returns
    -------
    ExposureSolutions

    Raises
    ------
    InputError
        If the matches have no epochs.
    DegenerateError
        If no exposure has enough stars that cover each chip.
    """
    if matches.epoch is None:
        raise InputError(
            "a series in time needs the epoch of every exposure",
            where="data.columns",
            do="map column 'epoch'",
        )
    alone = replace(bare_model(model), time=None)
    order = np.argsort(matches.exposure, kind="stable")
    codes, starts = np.unique(matches.exposure[order], return_index=True)
    names, epochs, views, terms = [], [], [], []
    skipped: dict[str, str] = {}
    for code, rows in zip(codes, np.split(order, starts[1:]), strict=True):
        name = matches.exposure_names[code]
        table = matches.select(np.sort(rows))
        try:
            _require_stars(table, alone)
            fit = fit_linear(table, alone, rejection=rejection)
        except DegenerateError as error:
            skipped[name] = error.cause
            continue
        view = reference_gauge(fit, chip)
        names.append(name)
        epochs.append(float(np.median(table.column("epoch"))))
        views.append(view)
        terms.append(linear_terms(view))
    if not names:
        raise DegenerateError(
            f"none of {len(codes)} exposures can be fitted: {next(iter(skipped.values()))}",
            where=", ".join(matches.sources),
            do="lower model.order",
        )
    return ExposureSolutions(
        names=tuple(names),
        epoch=np.array(epochs),
        labels=terms[0].labels,
        values=np.array([t.values for t in terms]),
        cov=np.array([t.cov for t in terms]),
        views=tuple(views),
        skipped=skipped,
    )


def _require_stars(table: Matches, model: DistortionModel) -> None:
    """Raise DegenerateError if a chip of the exposure has fewer stars than terms per axis."""
    numbers, n_terms = table.chip_number, model.n_terms
    for chip in model.chips:
        n = int((numbers == chip.number).sum())
        if n < n_terms:
            raise DegenerateError(
                f"{n} stars lie on this chip, fewer than the {n_terms} terms of an axis"
                if n
                else "no star lies on this chip",
                where=f"chip {chip.name}",
                do="lower model.order",
            )
