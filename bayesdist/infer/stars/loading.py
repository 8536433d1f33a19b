"""Shards of a model, in this process or on a cluster, from matches."""

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
    """Context with the data as shards, as of `load`; shards loaded here are closed at the end."""
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
        Shards are returned unchanged.
    compute : Compute, optional

    Returns
    -------
    Shards

    Raises
    ------
    InputError
        As `prepare`; for a full scratch folder; when there is no cluster.
    """
    if isinstance(matches, Shards):
        if matches.model != model:
            raise InputError(
                "the shards were made for another model", do="load the matches for this one"
            )
        return matches
    if not isinstance(matches, Matches):
        raise InputError(
            f"{type(matches).__name__} holds no matches",
            do="give what read_matches, open_matches or load returned",
        )
    compute = compute or Compute()
    if compute.engine == "threads":
        return LocalShards(model, matches, compute.memory_mb)
    # dask is imported where it is asked for
    from bayesdist.infer.stars.cluster import ClusterShards

    return ClusterShards(model, matches, compute)
