"""Loading of matches as shards of a model, in this process or on a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.stars.shards import Compute, LocalShards, Shards
from bayesdist.model import DistortionModel


@contextmanager
def opened(
    model: DistortionModel, matches: Matches | Shards, compute: Compute | None = None
) -> Iterator[Shards]:
    """Context with the data loaded as shards (see `load`), which are closed at the end.

    Shards that were passed as `matches` stay open.
    """
    shards = load(model, matches, compute)
    try:
        yield shards
    finally:
        if shards is not matches:
            shards.close()


def load(
    model: DistortionModel, matches: Matches | Shards, compute: Compute | None = None
) -> Shards:
    """Load the data as shards of a model.

    Parameters
    ----------
    model : DistortionModel
    matches : Matches or Shards
        Stars with errors. Shards of the same model are returned unchanged.
    compute : Compute, optional
        Computing engine; threads of this process by default.

    Returns
    -------
    Shards

    Raises
    ------
    InputError
        If the matches have no errors, another unit than the model, or lack required epochs; if
        shards belong to another model; if the scratch folder is full; or if the cluster cannot be
        reached.
    """
    if isinstance(matches, Shards):
        if matches.model != model:
            raise InputError(
                "the shards were made for another model", do="load the matches for this one"
            )
        return matches
    if not isinstance(matches, Matches):
        raise InputError(
            f"{type(matches).__name__} does not contain matches",
            do="give what read_matches, open_matches or load returned",
        )
    compute = compute or Compute()
    if compute.engine == "threads":
        return LocalShards(model, matches, compute.memory_mb)
    # dask is imported only if its engine is requested
    from bayesdist.infer.stars.cluster import ClusterShards

    return ClusterShards(model, matches, compute)
