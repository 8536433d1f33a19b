"""Linear terms of exposures that were fitted jointly: their scatter, and those of each alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.infer import GaussianPriors, Posterior
from bayesdist.infer.exposures.chip_offsets import Settling
from bayesdist.infer.sampler.checkpoints import read_arrays, write_arrays
from bayesdist.infer.series import Series
from bayesdist.reading.faults import restoring

__all__ = ["ExposureScatter", "read_hierarchy", "read_series", "write_hierarchy", "write_series"]

Float = NDArray[np.float64]

HIERARCHY, TERMS = "hierarchy.h5", "exposure_terms.h5"
FIT_AGAIN = "run the stage 'fit' again"


@dataclass(frozen=True, eq=False)
class ExposureScatter:
    """Scatter of the linear terms of exposures about those of the model.

    Parameters
    ----------
    kinds : tuple of str
        Kinds of deviation.
    tau : ndarray, shape (n, k)
        Draws of the scatter of each kind.
    offsets : Settling
        How the constant terms of chips follow from the shifts of single chips.
    """

    kinds: tuple[str, ...]
    tau: Float
    offsets: Settling

    def averaged(self, posterior: Posterior, rng: np.random.Generator) -> Posterior:
        """The posterior with the chips where the exposures have them on average."""
        some = self.tau[rng.integers(len(self.tau), size=len(posterior.flat))]
        theta = self.offsets.draws(posterior.flat, some, rng).reshape(posterior.theta.shape)
        return replace(posterior, theta=theta)


def write_hierarchy(folder: Path, scatter: ExposureScatter, priors: GaussianPriors) -> None:
    """Write the scatter of exposures, and the priors of their deviations."""
    arrays = {
        "kinds": np.array([kind.encode() for kind in scatter.kinds]),
        "tau_draws": scatter.tau,
        "prior_centre": priors.centre,
        "prior_precision": priors.precision,
        **scatter.offsets.to_arrays(),
    }
    write_arrays(folder / HIERARCHY, "", arrays)


def read_hierarchy(folder: Path) -> tuple[ExposureScatter, GaussianPriors]:
    """Read what `write_hierarchy` wrote.

    Raises
    ------
    InputError
        For a missing or damaged file.
    """
    path = folder / HIERARCHY
    arrays = read_arrays(path, "", do=FIT_AGAIN)
    with restoring(path, "the variation of exposures", do=FIT_AGAIN):
        kinds = tuple(str(t, "utf-8") for t in arrays["kinds"])
        scatter = ExposureScatter(kinds, arrays["tau_draws"], Settling.from_arrays(arrays))
        return scatter, GaussianPriors(arrays["prior_centre"], arrays["prior_precision"])


def write_series(folder: Path, series: Series) -> None:
    """Write the linear terms of exposures that were each fitted alone."""
    arrays = {"epoch": series.epoch, "values": series.values, "cov": series.cov}
    for key, texts in (("names", series.names), ("labels", series.coefficients)):
        arrays[key] = np.array([text.encode() for text in texts])
    write_arrays(folder / TERMS, "", arrays)


def read_series(folder: Path) -> Series:
    """Read what `write_series` wrote.

    Raises
    ------
    InputError
        For a missing or damaged file.
    """
    path = folder / TERMS
    arrays = read_arrays(path, "", do=FIT_AGAIN)
    with restoring(path, "a series of exposures", do=FIT_AGAIN):
        names, labels = (tuple(str(t, "utf-8") for t in arrays[key]) for key in ("names", "labels"))
        values = arrays["epoch"], arrays["values"], arrays["cov"]
        return Series(*values, labels, names, source="exposures")
