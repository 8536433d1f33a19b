"""Base class of the sections of a configuration file, and sections for detector and chips."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, ClassVar, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator

from bayesdist.model import Chip

Unit = Literal["pix", "arcsec", "mas", "deg"]
Epoch = Annotated[float, Field(ge=1800, le=2200)]  # decimal years; other numbers are days or errors
RightAscensionDeclination = tuple[  # degrees
    Annotated[float, Field(ge=-180, le=360)], Annotated[float, Field(ge=-90, le=90)]
]


class Section(BaseModel):
    """Section of a configuration file; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    # for error messages about unknown keys, by the path of the key in this section
    renamed: ClassVar[Mapping[str, str]] = {}  # new names of old keys
    instead: ClassVar[Mapping[str, str]] = {}  # advice for keys of other kinds of runs

    def faults(self) -> Iterator[str]:
        """Faults of the section as a whole, as 'cause; advice'; the first one is reported."""
        yield from ()

    @model_validator(mode="after")
    def _without_faults(self) -> Self:
        for fault in self.faults():
            raise ValueError(fault)
        return self


Pair = tuple[PositiveFloat, PositiveFloat]
Block = TypeVar("Block", bound="ChipBlock")


class Circle(Section):
    """Circular field on a detector, in pixels."""

    centre: tuple[float, float]
    radius: PositiveFloat


class Detector(Section):
    """Detector with one chip."""

    name: str = ""
    mission: str = ""
    instrument: str = ""
    filter: str = ""
    size: Pair | None = None
    scale_mas: PositiveFloat | None = None


class RunDetector(Detector):
    """Detector of a run, with the field over which errors are evaluated."""

    field: Circle | list[tuple[float, float]] | None = None


class ChipBlock(Section):
    """One of several chips."""

    number: int
    name: str
    size: Pair
    reference_pixel: Pair
    reference: bool = False


def detector_faults(
    chips: Sequence[ChipBlock], detector: Detector, reference_pixel: Pair | None
) -> Iterator[str]:
    """Faults of contradictory chips, and of a missing detector."""
    if sum(c.reference for c in chips) > 1:
        yield "reference = true occurs in several [[chip]] blocks; keep it in one"
    for key in ("number", "name"):
        yield from same_names("chip", [getattr(c, key) for c in chips], key)
    if chips and (detector.size or reference_pixel):
        yield (
            "[[chip]] blocks replace detector.size and model.reference_pixel; give one or the other"
        )
    if not chips and detector.size is None:
        yield "detector.size is missing; give it, or [[chip]] blocks"


def same_names(block: str, names: Sequence[object], key: str = "name") -> Iterator[str]:
    """Fault of blocks with equal names, or equal values of another unique key."""
    duplicate = next((name for name, n in Counter(names).items() if n > 1), None)
    if duplicate is not None:
        yield f"two [[{block}]] blocks have the {key} {duplicate!r}; give each a different one"


def reference_first(chips: Sequence[Block]) -> list[Block]:
    """Blocks with that of the reference chip, which defines the frame, as the first."""
    return sorted(chips, key=lambda c: not c.reference)


def chips_of(chips: Sequence[ChipBlock]) -> tuple[Chip, ...]:
    """Chips of the model."""
    blocks = reference_first(chips)
    return tuple(Chip(c.number, c.name, c.size, c.reference_pixel) for c in blocks)


def one_chip(detector: Detector, reference_pixel: Pair | None, number: int, name: str) -> Chip:
    """Chip of a detector that has only one; its reference pixel is the centre by default."""
    if detector.size is None:
        raise ValueError("detector.size is missing; give columns and rows")
    nx, ny = detector.size
    middle = ((nx + 1) / 2, (ny + 1) / 2)
    return Chip(number, detector.name or name, detector.size, reference_pixel or middle)


def names_nominal(columns: Mapping[str, str] | None) -> bool:
    """True if columns of nominal positions are named."""
    return any((columns or {}).get(key) for key in ("u_nominal", "v_nominal"))
