"""Stars of a run: their errors, the stars as they are read, and those that are held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from bayesdist.app.config import Config
from bayesdist.app.config.fit import HoldoutBlock
from bayesdist.data.magnitude_errors import AddedErrors, MagnitudeErrors
from bayesdist.data.matches import Matches
from bayesdist.data.preparing import HoldoutSpec, exposures_drawn, split_matches
from bayesdist.diagnose.residuals.stars import SAMPLE
from bayesdist.errors import InputError
from bayesdist.infer import Shards, build_model, load
from bayesdist.infer.stars.shards import Compute
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.checks import HELD_OUT


@dataclass(frozen=True, eq=False)
class ErrorLaw:
    """Rule that derives the errors of fitted and held-out stars from the quoted errors.

    Parameters
    ----------
    factor : float
        Factor on all quoted errors; 1 if these are adequate.
    by_magnitude : MagnitudeErrors or None
        Centroid errors as a function of magnitude, which replace the quoted errors or are added to
        them.
    added : AddedErrors or None
        Additional errors of groups of stars, added in quadrature.
    with_catalogue : bool
        True if `by_magnitude` is added in quadrature to the quoted errors, because these are the
        errors of the catalogue.
    """

    factor: float = 1.0
    by_magnitude: MagnitudeErrors | None = None
    added: AddedErrors | None = None
    with_catalogue: bool = False

    def applied(self, matches: Matches) -> Matches:
        """Matches with these errors applied; returned unchanged if the quoted errors are kept."""
        if self.factor != 1.0:
            matches = matches.with_scaled_errors(self.factor)
        if self.by_magnitude is not None:
            matches = matches.with_errors(self.by_magnitude, in_quadrature=self.with_catalogue)
        return (
            matches if self.added is None else matches.with_errors(self.added, in_quadrature=True)
        )


QUOTED = ErrorLaw()


class StarReader:
    """Reader of stars that caches the most recent request."""

    def __init__(self, compute: Compute | None = None) -> None:
        self.compute = compute or Compute()
        # requested stars, their error law, and the stars with these errors
        self._read: tuple[Matches, ErrorLaw, Matches] | None = None
        self._shards: Shards | None = None
        self._sample: Matches | None = None

    def matches(self, stars: Matches, errors: ErrorLaw = QUOTED) -> Matches:
        """Stars with their errors."""
        if self._read is None or self._read[0] is not stars or self._read[1] is not errors:
            self.close()
            self._read = stars, errors, errors.applied(stars)
        return self._read[2]

    def shards(self, model: DistortionModel, stars: Matches, errors: ErrorLaw = QUOTED) -> Shards:
        """Stars split into shards for passes of a model; closed together with the reader."""
        matches = self.matches(stars, errors)
        if self._shards is None or self._shards.model != model:
            self._close_shards()
            self._shards = load(model, matches, self.compute)
        return self._shards

    def sample(self, stars: Matches, errors: ErrorLaw = QUOTED) -> Matches:
        """Evenly spread subset of the stars, or all of them if they are few."""
        matches = self.matches(stars, errors)
        if self._sample is None:
            self._sample = matches.sample(SAMPLE)
        return self._sample

    def moved(self, stars: Matches) -> None:
        """Update the cache after the files of the stars in use were moved.

        `stars` are the same stars, which refer to the new files.
        """
        if self._read is None or self.compute.engine == "dask":  # workers may read the files again
            self.close()
        else:
            errors = self._read[1]
            self._read = stars, errors, errors.applied(stars)

    def close(self) -> None:
        """Release the stars, and the workers that hold them."""
        self._close_shards()
        self._read = self._sample = None

    def _close_shards(self) -> None:
        if self._shards is not None:
            self._shards.close()
            self._shards = None


def in_circle(stars: Matches, config: Config) -> bool:
    """True if stars were matched within a known radius of nominal positions that are in the data.

    The likelihood then accounts for this selection.
    """
    if config.begins_with != "fit" or not stars.has_nominal:
        return False
    return config.match_radius(stars.match_radius) is not None


def model_of(stars: Matches, config: Config) -> DistortionModel:
    """Distortion model of a configuration for the given stars."""
    check_chips(config.chips(), stars.chip_numbers)
    return build_model(
        stars,
        order=config.model.order,
        size=config.detector.size,
        reference_pixel=config.model.reference_pixel,
        name=config.detector.name,
        chips=config.chips(),
        frames=config.model.frames,
        time=config.time(),
    )


def shards_of(
    stars: Matches, model: DistortionModel, config: Config, errors: ErrorLaw, reader: StarReader
) -> Shards:
    """Stars in shards for passes over the data; raises if any is outside its match circle."""
    shards = reader.shards(model, stars, errors)
    if in_circle(stars, config):
        shards.survey.check_circle(config.match_radius(stars.match_radius))
    return shards


def check_chips(chips: Sequence[Chip], numbers: Sequence[int]) -> None:
    """Refuse a ``[[chip]]`` block without stars, and stars without a block.

    `numbers` are the chips of the matches, (1,) also if the matches name no chip.  Nothing is
    checked if there are no blocks.
    """
    if not chips:
        return
    # stars without a chip are on the only chip, regardless of its number
    if len(chips) == 1 and tuple(numbers) in ((1,), (chips[0].number,)):
        return
    block_numbers = {c.number for c in chips}
    unknown = [str(n) for n in numbers if n not in block_numbers]
    empty = [f"{c.number} ({c.name})" for c in chips if c.number not in set(numbers)]
    if unknown:
        plural = "chips" if len(unknown) > 1 else "chip"
        raise InputError(
            f"there are stars on {plural} {', '.join(unknown)}, which no [[chip]] block describes",
            where="chip",
            do=f"add a block, or leave these stars out (known: "
            f"{', '.join(str(c.number) for c in chips)})",
        )
    if empty:
        plural = "chips" if len(empty) > 1 else "chip"
        raise InputError(
            f"no star lies on {plural} {', '.join(empty)}",
            where="chip",
            do="drop the block, or map column 'chip' in data.columns",
        )


class RunInput(Protocol):
    """Matches of a run that may have to be written to disk before they can be used."""

    def load(self) -> Matches:
        """All matches that the configuration selects."""

    def move_into_run(self) -> bool:
        """Move the matches into the folder of the run, which has begun; True if any were moved."""

    def close(self) -> None:
        """Remove files that were not moved."""


def set_aside(
    config: Config, matches: Matches, needed: int = 0
) -> tuple[Matches, Matches | None, tuple[str, ...]]:
    """Matches to fit, held-out matches, and the names of exposures that are held out entirely.

    Parameters
    ----------
    config : Config
        Its section [holdout] says which stars are held out; without it none are.
    matches : Matches
    needed : int
        Number of leading exposures that define the gauge and therefore cannot be held out.

    Raises
    ------
    InputError
        If too few stars would be held out, or an exposure that defines the gauge is named.
    """
    block = config.holdout
    if block is None:
        return matches, None, ()
    held_exposures = _whole_exposures(block, config.sampler.seed, matches.exposure_names, needed)
    split = split_matches(matches, HoldoutSpec(block.fraction, held_exposures, config.sampler.seed))
    if not HELD_OUT.met_by(len(split.held)):
        raise InputError(
            f"{len(split.held)} of {len(matches)} stars are held out, too few to judge the "
            "solution",
            where=", ".join(matches.sources),
            do=f"hold out at least {HELD_OUT.value}: raise holdout.fraction",
        )
    return split.kept, split.held, held_exposures


def _whole_exposures(
    block: HoldoutBlock, seed: int, names: tuple[str, ...], needed: int
) -> tuple[str, ...]:
    """Exposures to hold out entirely: those named, or a number drawn with the seed."""
    if isinstance(block.exposures, int):
        return exposures_drawn(names[needed:], block.exposures, seed)
    for name in block.exposures:
        if name in names[:needed]:
            raise InputError(
                f"exposure {name!r} is to be held out, but it defines the gauge",
                where="holdout.exposures",
                do="name another one",
            )
    return tuple(dict.fromkeys(block.exposures))
