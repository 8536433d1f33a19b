"""Reading of the matches of a section [data], in memory or on disk, including mission formats."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from bayesdist.app.config import ChipBlock
from bayesdist.app.stars import RunInput
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import Matches, input_files, open_matches, read_matches
from bayesdist.data.batches import BATCH
from bayesdist.data.reading.options import ReadArguments
from bayesdist.data.tables.parquet import describe_part
from bayesdist.data.tangent import separation, sky_of_plane
from bayesdist.errors import InputError
from bayesdist.kinds.matches.config import Data
from bayesdist.plugin import mission_objects

log = logging.getLogger("bayesdist")

SAME_POINT = 1e-6  # arcsec, the distance below which tangent points are the same

PathLike = str | os.PathLike[str]


def load_matches(
    path: PathLike | Sequence[PathLike],
    *,
    format: str = "auto",
    rows_in_memory: int = BATCH,
    **options: Unpack[ReadArguments],
) -> Matches:
    """Read matches of any known format; large Parquet tables stay on disk.

    Tables of more rows than `rows_in_memory` are processed in batches of at most as many. The
    other arguments are those of `read_matches`.
    """
    if format in ("auto", "table") and is_large(path, rows_in_memory):
        if options.pop("not_finite", "refuse") == "reject":
            raise InputError(
                f"rows of tables of more than {rows_in_memory} rows cannot be left out in reading",
                where="data.not_finite",
                do="write the table without them",
            )
        options.pop("same_position", None)  # equal positions are searched only in memory
        return open_matches(path, batch_rows=rows_in_memory, **options)
    return read_matches(path, format=format, **options)


def reading_options(data: Data, chips: Sequence[ChipBlock]) -> ReadArguments:
    """Options of `load_matches` from a section [data]; tables may refer to chips by name."""
    return {
        "columns": data.columns,
        "unit": data.unit,
        "sigma": data.sigma,
        "pixel_origin": data.pixel_origin,
        "tangent_point": data.tangent_point,
        "epoch": data.epoch,
        "catalogue_epoch": data.catalogue_epoch,
        "chips": {chip.name: chip.number for chip in chips} or None,
        "not_finite": data.not_finite,
        "same_position": data.same_position,
        "plate_scale": data.plate_scale,
        "motion_prior": data.motion_prior,
    }


def is_large(path: PathLike | Sequence[PathLike], rows_in_memory: int) -> bool:
    """True if the files are in Parquet with too many rows to be held in memory."""
    files = input_files(path)
    if any(file.suffix.lower() != ".parquet" for file in files):
        return False
    return sum(describe_part(file).n_rows for file in files) > rows_in_memory


Paths = str | Path | Sequence[str | Path]
Template = tuple[int, dict[str, object]]


@dataclass(frozen=True)
class MatchSource:
    """Reader of matches in the format of a mission.

    Parameters
    ----------
    read : callable
        ``read(paths, data, size)`` returns the matches in memory; `data` is the section [data] of
        the mission, `size` the number of columns and rows of the detector.
    input_of : callable
        ``input_of(run)`` returns the `RunInput` of a run directory.
    template : callable
        ``template(path)`` returns the number of matches and their entries in the template of a
        configuration, for `bayesdist init`; None if the files have another format.
    """

    read: Callable[[Paths, Any, tuple[float, float]], Matches]
    input_of: Callable[[RunDirectory], RunInput]
    template: Callable[[str | Path], Template | None]


def source_of(name: str) -> MatchSource | None:
    """Match source of a format; None for formats that are not of a mission."""
    return mission_objects(lambda mission: mission.match_sources, only=name).get(name)


def read_configured(
    path: Paths,
    data: Data,
    *,
    size: tuple[float, float] | None,
    chips: Sequence[ChipBlock],
) -> Matches:
    """Read the matches of a section [data].

    `size` is the number of columns and rows of a detector with a single chip.
    """
    source = source_of(data.format)
    if source is not None and size is not None:
        return source.read(path, data, size)
    options = reading_options(data, chips)
    return load_matches(path, format=data.format, rows_in_memory=data.rows_in_memory, **options)


def read_on_plane(
    earlier: Calibration, data: Data, read: Callable[[Data], Matches], *, frames: str
) -> Matches:
    """Read matches that are compared with an earlier calibration, on its tangent plane.

    The default tangent point is the mean direction of the stars, so that other stars of the same
    field would have another plane.  The point of the calibration is used in its place, except for
    stars of another field whose exposures have frames.

    Parameters
    ----------
    earlier : Calibration
    data : Data
        Section that states how to read the matches.
    read : callable
        ``read(data)`` returns the matches of a section.
    frames : str
        Frames between the matches and the calibration; see `refuse_other_plane`.

    Returns
    -------
    Matches

    Raises
    ------
    InputError
        As for `refuse_other_plane`.
    """
    matches, point = read(data), earlier.plane.point
    if point is None or matches.tangent_point in (None, point):
        return matches
    if data.tangent_point is None and _in_field(earlier, point, matches.tangent_point):
        try:
            matches = read(data.model_copy(update={"tangent_point": point}))
        except InputError:  # the file itself states u, v and their tangent point
            log.debug("the tangent point of %s cannot be chosen", ", ".join(matches.sources))
    refuse_other_plane(earlier, matches, frames=frames)
    return matches


def refuse_other_plane(earlier: Calibration, matches: Matches, *, frames: str) -> None:
    """Raise InputError if matches and an earlier calibration have different tangent planes.

    Two planes differ by a shift and a rotation, and by terms that are negligible in a small field.
    `frames` is the kind of frames that are fitted between the matches and the calibration: those
    with a rotation absorb the difference, and shifts absorb the pointing to another field.
    """
    point, other = earlier.plane.point, matches.tangent_point
    if point is None or other is None or 3600.0 * separation(point, *other) < SAME_POINT:
        return
    where = ", ".join(matches.sources)
    if not _in_field(earlier, point, other):
        if frames != "none":
            return
        raise InputError(
            f"the stars are {separation(point, *other):.3g} degrees from those of {earlier.name}, "
            "which are in one frame, so that a pointing cannot be told from a distortion",
            where=where,
            do="give stars of the same field, or fit frames of exposures (model.frames)",
        )
    if frames in ("none", "shift"):
        raise InputError(
            f"the tangent point of the positions is {list(other)}, but that of {earlier.name} is "
            f"{list(point)}, which moves or rotates all stars without a change of the distortion",
            where=where,
            do=f"give RA and Dec, with data.tangent_point = {list(point)} or without it",
        )


def _in_field(
    earlier: Calibration, point: tuple[float, float], direction: tuple[float, float]
) -> bool:
    """True if a direction is at most a diameter of the detector from the centre of its field.

    `point` is the tangent point of the calibration; both are RA and Dec in degrees.
    """
    time = earlier.model.time
    corners = np.concatenate(
        [
            earlier.forward(
                *np.array([[1.0, 1.0, chip.size[0], chip.size[0]], [1.0, chip.size[1]] * 2]),
                chip=chip.number,
                epoch=None if time is None else time.epoch0[0],
            )
            for chip in earlier.model.chips
        ]
    )
    corners = corners * ARCSEC[earlier.unit]
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    radius = np.hypot(*(corners - centre).T).max()
    ra, dec = sky_of_plane(centre[0], centre[1], point)
    return bool(3600.0 * separation(direction, ra, dec) <= 2.0 * radius)


def mission_template(matches: str | Path) -> Template | None:
    """Number of matches and their part of a template; None if no mission reads the files."""
    for source in mission_objects(lambda mission: mission.match_sources).values():
        template = source.template(matches)
        if template is not None:
            return template
    return None
