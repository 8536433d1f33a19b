"""`bayesdist convert`: write a calibration in another format, and report what is lost."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, time
from pathlib import Path
from typing import Any

import numpy as np

from bayesdist.app.calibrations import (
    calibration_at,
    on_the_sky,
    positions_on_the_sky,
    refuse_unused_date,
)
from bayesdist.app.screen import number as digits
from bayesdist.app.store.record import refuse_existing
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import InputError
from bayesdist.files.atomic import made_folder
from bayesdist.files.documents import toml_of
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Choice,
    FormatSettings,
)
from bayesdist.products.registry import format_of, open_document
from bayesdist.products.sampled import SampledCalibration, sampled_calibration
from bayesdist.products.writing import (
    built_for,
    places_of,
    refuse_unknown_scale,
    representable,
    settings_of,
    write_built,
)
from bayesdist.utils.arrays import Float

_GRID = 65  # grid points per axis on which the loss is measured
BAD_PIX = 0.1  # pixels: larger errors of a sampled polynomial cause a warning
_ROUNDING = 1e-6  # pixels: smaller differences count as none


def convert(
    path: str | Path,
    to: str,
    output: str | Path | None = None,
    *,
    options: Sequence[str] = (),
    order: int | None = None,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    scale: float | None = None,
    size: tuple[float, float] | None = None,
    sample: bool = False,
    force: bool = False,
) -> str:
    """Write the calibration of a file or a run in another format, and report what is lost.

    Parameters
    ----------
    path : path
        Calibration file or run.
    to : str
        Key of a format that can be written.
    output : path, optional
        Folder, or file name if the format consists of one file; the current folder by default.
    options : sequence of str
        KEY=VALUE of the section of the format in a configuration, with values as in TOML.
    order : int, optional
        Order of the output polynomial; that of the calibration by default.  Look-up tables are
        included in the polynomial if the format cannot hold them.
    chip : int, optional
        Number of the only chip to convert.
    filter, epoch, size
        See `calibration_at`.
    scale : float, optional
        Pixel size in arcsec; that of the run by default.
    sample : bool
        The file is a header of any projection, which is sampled through astropy.wcs and fitted by a
        polynomial of `order`, by default a sufficient one.
    force : bool
        Replace existing files.

    Returns
    -------
    str
        Text to print.

    Raises
    ------
    InputError
        If the format cannot hold the calibration, or files exist and are not to be replaced.
    """
    target = format_of(to)
    sampled = _sampled(path, order, size, chip=chip, filter=filter, epoch=epoch) if sample else None
    if sampled is None:
        calibration = on_the_sky(Path(path), calibration_at(path, filter=filter, size=size))
        refuse_unused_date(epoch, calibration)
    else:
        calibration, order = sampled.calibration, None
    settings = _settings(to, options)
    source = calibration if chip is None else calibration.only(chip, epoch)
    at = None
    if source.model.time is not None:
        at = source.reference_date if epoch is None else epoch
    converted, notes = representable(source, target, order, at)
    if scale is None and source.pixel_mas is not None:
        scale = source.pixel_mas / 1000
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale is {scale}", where="--scale", do="give a positive number")
    refuse_unknown_scale(converted, target, settings, scale)
    place = _target(output)
    built = built_for(to, converted, settings, BuildOptions(at, scale), place)
    places = places_of(built, place)
    for path_of_file in places:
        refuse_existing(path_of_file, force)
    write_built(built, places)
    held = [p for p, file in zip(places, built, strict=True) if file.kind != PARAMETERS]
    lines = [f"{', '.join(str(p) for p in places)}: by {source.name}"]
    if sampled is not None:
        lines.append(f"  {sampled.sentence}")
        if sampled.largest_pix > BAD_PIX:
            lines.append("  warning: no polynomial follows this header well; do not use it blindly")
    back = _read_back(held, filter, converted.model.chips[0].size)
    lines += [f"  {note}" for note in (*source.notes, *notes)]
    if source.errors == "none":
        lines.append("  note: it states no errors, and neither do the new files")
    lines += [f"  warning: {w}" for w in dict.fromkeys(w for file in built for w in file.warnings)]
    lines += [f"  note: {n}" for n in dict.fromkeys(n for file in built for n in file.notes)]
    used = _read_back(held, filter, converted.model.chips[0].size, as_used=True)
    lines += [f"  {line}" for line in _losses(source, back, used, at, scale)]
    return "\n".join(lines)


def _sampled(
    path: str | Path, order: int | None, size: tuple[float, float] | None, **others: object
) -> SampledCalibration:
    """Calibration sampled from a header; options that do not apply to it are refused."""
    refused = next((name for name, value in others.items() if value is not None), None)
    if refused is not None:
        raise InputError(
            "a sampled header has one chip, no filter and no dates",
            where=f"--{refused}",
            do="leave it out",
        )
    if Path(path).is_dir():
        raise InputError(
            "is a folder, but --sample needs a header", where=str(path), do="leave --sample out"
        )
    return sampled_calibration(path, order=order, size=size)


def _settings(to: str, options: Sequence[str]) -> FormatSettings:
    """Settings of a format from KEY=VALUE, with values as in TOML."""
    values: dict[str, Any] = {}
    for text in options:
        key, mark, value = text.partition("=")
        if not mark or not key.strip():
            raise InputError(
                f"{text!r} is not KEY=VALUE", where="--option", do="write it in that form"
            )
        try:
            parsed = toml_of(f"x = {value}", "--option")["x"]
        except InputError:
            parsed = value.strip()
        # dates are text in settings
        values[key.strip()] = value.strip() if isinstance(parsed, (date, time)) else parsed
    return settings_of(to, values)


# -- files ----------------------------------------------------------------------------------------


def _target(output: str | Path | None) -> Path:
    """Folder, which is created if necessary, or file to write."""
    target = Path("." if output is None else output)
    made_folder(target.parent if target.suffix and not target.is_dir() else target)
    return target


def _read_back(
    places: Sequence[Path],
    filter: str | None,
    size: tuple[float, float],
    *,
    as_used: bool = False,
) -> list[Calibration]:
    """Calibrations of the written files; with `as_used` as other programs interpret them."""
    return [open_document(place).calibration(Choice(filter, size, as_used)) for place in places]


# -- losses ---------------------------------------------------------------------------------------


def _losses(
    source: Calibration,
    back: Sequence[Calibration],
    used: Sequence[Calibration],
    epoch: float | None,
    scale: float | None,
) -> list[str]:
    lines = []
    errors = min(
        (calibration.errors for calibration in back), key=("none", "sigma", "covariance").index
    )
    if source.errors == "covariance" and errors != "covariance":
        lost = {"sigma": "correlations of the coefficients", "none": "all errors"}[errors]
        lines.append(f"lost: {lost}")
    elif source.errors == "sigma" and errors == "none":
        lines.append("lost: all errors")
    apart = len(back) > 1 and not _comparable(source, back) and source.plane.point is None
    if apart:
        lines.append("lost: where the chips lie to each other, of which each has a file")
    if len(back) > 1 and source.errors == "covariance":
        lines.append("lost: correlations between chips, of which each has a file")
    if source.model.time is not None and all(
        calibration.model.time is None for calibration in back
    ):
        lines.append(f"lost: the dependence on time; the file is of {epoch:g}")
    if source.plane.kind == "sky" and all(calibration.plane.kind != "sky" for calibration in back):
        lines.append("lost: where the plane touches the sky")
    worst, rms, frame = _difference(source, used, epoch)
    mas = _mas_per_pixel(source, scale, epoch)
    text = f"{digits(worst, 3)} pix at worst"
    if mas is not None:
        text += f" ({digits(worst * mas, 3)} mas)"
    text += f", {digits(rms, 3)} pix rms"
    if worst < _ROUNDING:
        return [*lines, f"positions agree: {text}{frame}"]
    return [*lines, f"positions differ by {text}{frame}"]


def _difference(
    source: Calibration, back: Sequence[Calibration], epoch: float | None
) -> tuple[float, float, str]:
    """Largest and rms difference of positions over the detector in pixels, and a note on the frame.

    Positions are compared on the sky if both calibrations are on the sky, and directly if both have
    the same plane and unit.  Otherwise the best similarity is removed first, because planes of
    different kinds agree only up to a similarity: one for all chips, or one per chip if each has
    its own file.
    """
    source_positions, file_positions, pixels = [], [], []
    pairs = _pairs(source, back)
    sky = source.plane.point is not None and all(
        calibration.plane.point for _, calibration, _ in pairs
    )
    for number, calibration, its in pairs:
        size = source.model.chips[source.numbers.index(number)].size
        x, y = detector_grid(size, _GRID)
        a = source.forward(x, y, chip=number, epoch=epoch)
        drifts = epoch if calibration.model.time is not None else None
        b = calibration.forward(x, y, chip=its, epoch=drifts)
        if sky:
            a, b = (
                np.stack(positions_on_the_sky(c, p), axis=-1)
                for c, p in ((source, a), (calibration, b))
            )
        source_positions.append(a)
        file_positions.append(b)
        pixels.append(float(np.sqrt(abs(np.linalg.det(source.chip(number, epoch).linear)))))
    if not sky and not _comparable(source, back) and len(back) == 1:
        source_positions, file_positions = (
            [np.concatenate(source_positions)],
            [np.concatenate(file_positions)],
        )
    parts, frame = [], ""
    for k, (a, b) in enumerate(zip(source_positions, file_positions, strict=True)):
        if sky:
            east = (a[:, 0] - b[:, 0] + 180) % 360 - 180
            far = 3600 * np.hypot(east * np.cos(np.radians(a[:, 1])), a[:, 1] - b[:, 1])
            far, frame = far / ARCSEC[source.unit], ", on the sky"
        elif _comparable(source, back):
            far = np.hypot(*(a - b).T)
        else:
            far = _after_similarity(a, b)
            frame = ", after the best shift, rotation and scale"
            frame += " of each chip" if len(back) > 1 else ""
        parts.append(far / pixels[k])
    off = np.concatenate(parts)
    return float(off.max()), float(np.sqrt(np.mean(off**2))), frame


def _comparable(source: Calibration, back: Sequence[Calibration]) -> bool:
    """True if both have the same plane, unit and zero point."""
    mine = (source.plane.kind, source.unit)
    is_equal = all((calibration.plane.kind, calibration.unit) == mine for calibration in back)
    return is_equal and source.plane.kind != "aperture"


def _pairs(source: Calibration, back: Sequence[Calibration]) -> list[tuple[int, Calibration, int]]:
    """Chip numbers of the source, each with its file and its number in the file."""
    if len(back) == len(source.numbers):  # one file per chip
        return [
            (n, calibration, calibration.numbers[0])
            for n, calibration in zip(source.numbers, back, strict=True)
        ]
    [calibration] = back
    return [
        (n, calibration, n if n in calibration.numbers else calibration.numbers[0])
        for n in source.numbers
    ]


def _after_similarity(a: Float, b: Float) -> Float:
    """Distances after the best similarity, mirrored or not."""
    z, w = (at[:, 0] + 1j * at[:, 1] for at in (a, b))
    residuals = []
    for v in (w, w.conj()):
        v, centred = v - v.mean(), z - z.mean()
        residuals.append(np.abs(centred - np.vdot(v, centred) / np.vdot(v, v) * v))
    return min(residuals, key=lambda far: float(far.max()))


def _mas_per_pixel(source: Calibration, scale: float | None, epoch: float | None) -> float | None:
    if source.unit == "pix":
        return None if scale is None else 1e3 * scale
    return 1e3 * ARCSEC[source.unit] * source.pixel(epoch)[0]
