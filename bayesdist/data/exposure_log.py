"""Each exposure's epoch, filter, aberration, roll and target."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.sky.earth import velocity_aberration
from bayesdist.errors import InputError

__all__ = ["NUMBERS", "Exposure", "ExposureLog"]

NUMBERS = ("exptime", "vafactor", "pa_v3", "ra", "dec")
_SLOWEST = 2e-4  # |VAFACTOR - 1| of anything in orbit about the Earth stays below 1.4e-4


@dataclass(frozen=True)
class Exposure:
    """One exposure.

    Parameters
    ----------
    name : str
    epoch : float
        Decimal year of its middle.
    filter : str
        Empty where it is not known.
    exptime : float, optional
        Seconds.
    vafactor : float, optional
        Scale factor of velocity aberration, as the keyword VAFACTOR.
    pa_v3 : float, optional
        Position angle of the V3 axis, degrees.
    ra, dec : float, optional
        Target, degrees.

    Raises
    ------
    InputError
        For an empty name, numbers that are not finite, or a factor that no orbit brings about.
    """

    name: str
    epoch: float
    filter: str = ""
    exptime: float | None = None
    vafactor: float | None = None
    pa_v3: float | None = None
    ra: float | None = None
    dec: float | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("an exposure has no name", do="name it")
        for key in ("epoch", *NUMBERS):
            value = getattr(self, key)
            if value is not None and not np.isfinite(value):
                raise InputError(
                    f"{key} is {value}, and must be finite",
                    where=f"exposure {self.name}",
                    do="correct it or leave it out",
                )
        if self.vafactor is not None and abs(self.vafactor - 1.0) > _SLOWEST:
            raise InputError(
                f"VAFACTOR is {self.vafactor}, and lies within {_SLOWEST:g} of 1 for every orbit",
                where=f"exposure {self.name}",
                do="give the keyword VAFACTOR of the science header",
            )


@dataclass(frozen=True, eq=False)
class ExposureLog:
    """Exposures by name.

    Parameters
    ----------
    exposures : tuple of Exposure
    source : str
        File.

    Raises
    ------
    InputError
        For no exposures, or a repeated one.
    """

    exposures: tuple[Exposure, ...]
    source: str = "exposure log"

    def __post_init__(self) -> None:
        object.__setattr__(self, "exposures", tuple(self.exposures))
        if not self.exposures:
            raise InputError("holds no exposures", where=self.source, do="name at least one")
        names = [one.name for one in self.exposures]
        if len(self._by_name) < len(names):
            again = next(name for k, name in enumerate(names) if name in names[:k])
            raise InputError(
                f"exposure {again} stands twice", where=self.source, do="name each only once"
            )

    @cached_property
    def _by_name(self) -> dict[str, Exposure]:
        return {one.name: one for one in self.exposures}

    def __len__(self) -> int:
        return len(self.exposures)

    def __iter__(self) -> Iterator[Exposure]:
        return iter(self.exposures)

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def __getitem__(self, name: str) -> Exposure:
        """The exposure of a name; InputError where there is none."""
        try:
            return self._by_name[name]
        except KeyError:
            raise InputError(
                f"has no exposure {name!r}", where=self.source, do="add it to the log"
            ) from None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the exposures, in their order."""
        return tuple(one.name for one in self.exposures)

    @property
    def filters(self) -> tuple[str, ...]:
        """Filters, in the order of their first appearance."""
        return tuple(dict.fromkeys(one.filter for one in self.exposures))

    def select(
        self,
        *,
        filter: str | Collection[str] | None = None,
        epochs: tuple[float, float] | None = None,
        names: Collection[str] | None = None,
    ) -> ExposureLog:
        """Some of the exposures.

        Parameters
        ----------
        filter : str or collection of str, optional
        epochs : tuple of float, optional
            First decimal year, and the one before which the epochs end.
        names : collection of str, optional

        Returns
        -------
        ExposureLog

        Raises
        ------
        InputError
            When none is left.
        """
        filters = (filter,) if isinstance(filter, str) else filter
        chosen = [
            one
            for one in self.exposures
            if (filters is None or one.filter in filters)
            and (epochs is None or epochs[0] <= one.epoch < epochs[1])
            and (names is None or one.name in names)
        ]
        if not chosen:
            raise InputError(
                f"no exposure has filter {filter}, epochs {epochs}, names {names}",
                where=self.source,
                do="widen the selection",
            )
        return replace(self, exposures=tuple(chosen))

    def require(self, *quantities: str) -> None:
        """Refuse a log in which an exposure lacks a quantity.

        Parameters
        ----------
        *quantities : str
            'filter', 'exptime', 'vafactor', 'pa_v3', 'ra' or 'dec'.

        Raises
        ------
        InputError
            Naming the first exposure that lacks one.
        """
        for one in self.exposures:
            for key in quantities:
                if getattr(one, key) in (None, ""):
                    do = "add it to the log"
                    if key == "vafactor":
                        do += (
                            ", or compute it from epoch, ra and dec "
                            "(campaign.vafactor_source = 'earth')"
                        )
                    raise InputError(f"exposure {one.name} has no {key}", where=self.source, do=do)

    def values(self, quantity: str) -> NDArray[np.float64]:
        """A number of each exposure, NaN where it is not known.

        Parameters
        ----------
        quantity : {'epoch', 'exptime', 'vafactor', 'pa_v3', 'ra', 'dec'}

        Returns
        -------
        ndarray, shape (number of exposures,)
        """
        found = (getattr(one, quantity) for one in self.exposures)
        return np.array([np.nan if value is None else value for value in found], float)

    def with_aberration(self) -> ExposureLog:
        """Log with VAFACTOR computed where it is missing.

        Only the motion of the Earth counts; the orbit of HST adds up to 2.5e-5.

        Returns
        -------
        ExposureLog

        Raises
        ------
        InputError
            When an exposure has neither the factor nor a target.
        """
        out = []
        for one in self.exposures:
            if one.vafactor is None:
                if one.ra is None or one.dec is None:
                    raise InputError(
                        f"exposure {one.name} has neither vafactor nor ra and dec to compute it",
                        where=self.source,
                        do="add one of them to the log",
                    )
                factor = velocity_aberration(one.epoch, one.ra, one.dec)
                one = replace(one, vafactor=factor)
            out.append(one)
        return replace(self, exposures=tuple(out))
