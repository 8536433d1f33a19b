"""Distortion model, its priors, and look-up tables; each kind of run has the keys that it uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, PositiveFloat

from bayesdist.app.config.section import Epoch, Pair, Section
from bayesdist.model import TimeDependence
from bayesdist.model.basis import MAX_ORDER

FrameKind = Literal["none", "shift", "shift_rotation", "shift_rotation_scale", "affine"]


class BaseTdd(Section):
    """Terms that drift linearly with time, with the keys that all kinds of runs have."""

    if TYPE_CHECKING:

        @property
        def rates(self) -> str: ...

    epoch0: Epoch | list[Epoch]
    terms: list[tuple[Literal["u", "v"], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]]
    breaks: list[Epoch] = Field(default_factory=list)

    def time(self) -> TimeDependence | None:
        """Time dependence of the model; None without terms."""
        if not self.terms:
            return None
        epochs = self.epoch0 if isinstance(self.epoch0, list) else [self.epoch0]
        return TimeDependence(tuple(self.terms), tuple(epochs), tuple(self.breaks))


class Tdd(BaseTdd):
    """Terms that drift linearly with time."""

    rates: ClassVar[str] = "free"


class Polynomials(Section):
    """Order and reference pixel of the polynomials."""

    order: Annotated[int, Field(ge=1, le=MAX_ORDER)]
    reference_pixel: Pair | None = None


class StructureBlock(Polynomials):
    """Structure of the distortion model, with the keys that all kinds of runs have."""

    if TYPE_CHECKING:

        @property
        def frames(self) -> FrameKind: ...
        @property
        def tdd(self) -> BaseTdd | None: ...


class MatchedModel(StructureBlock):
    """Structure of the distortion model, with the frames of the exposures."""

    frames: FrameKind = "none"
    tdd: Tdd | None = None


class PriorBlock(Section):
    """Gaussian prior on one parameter."""

    parameter: str
    mean: float
    sigma: PositiveFloat


class PriorCalibrationBlock(Section):
    """Earlier calibration of the detector that is used as a prior."""

    source: str
    frame: FrameKind | None = None
    filter: str | None = None
    epoch: float | None = None
    change_pix: Annotated[float, Field(ge=0)] = 0.0


class TablesBlock(Section):
    """Look-up tables to fit: of the detector, or of the filter in addition to the detector's."""

    detector: str | None = None
    method: Literal["field", "binned", "none"] = "field"
    step: tuple[PositiveFloat, PositiveFloat] = (64.0, 64.0)
    max_iterations: Annotated[int, Field(ge=1)] = 8
