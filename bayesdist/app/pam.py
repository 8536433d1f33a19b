"""`bayesdist pam`: pixel area maps of a calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesdist.app.applied import applied, images_of
from bayesdist.app.output import refuse_existing
from bayesdist.app.screen import number
from bayesdist.errors import InputError
from bayesdist.products.pam import PixelAreaMap, pixel_area_map, write_pam
from bayesdist.products.subarray import FULL

__all__ = ["write_area_maps"]


def write_area_maps(
    path: str | Path,
    output: str | Path,
    *,
    chip: int | None = None,
    filter: str | None = None,
    epoch: float | None = None,
    scale: float | None = None,
    image: str | Path | None = None,
    force: bool = False,
) -> str:
    """Write the pixel area maps of a calibration.

    Parameters
    ----------
    path : path
        As of `applied`.
    output : path
        A FITS file.
    chip : int, optional
        All by default.
    filter, epoch, scale
        As of `applied`.
    image : path, optional
        A calibrated image: maps are of its chips, in its order, and of its subarrays.
    force : bool
        Replace a file that is there.

    Returns
    -------
    str
        What to print.

    Raises
    ------
    InputError
        For what cannot be read or written.
    """
    output = Path(output)
    if output.suffix.lower() != ".fits":
        raise InputError(
            f"extension {output.suffix!r} is not that of a FITS file",
            where=str(output),
            do="choose a name that ends in .fits",
        )
    refuse_existing(output, force)
    found = applied(path, filter=filter, epoch=epoch, scale=scale)
    images = images_of(found, image=image)
    numbers = list(images or found.chips)
    if chip is not None:
        if chip not in numbers:
            raise InputError(
                f"there is no chip {chip}",
                where=found.name,
                do=f"choose one of {', '.join(map(str, numbers))}",
            )
        numbers = [chip]
    maps = [pixel_area_map(found.chips[n], found.scale, image=images.get(n, FULL)) for n in numbers]
    write_pam(
        output,
        maps,
        instrument=found.instrument,
        detector=found.detector,
        source=found.name,
    )
    notes = "".join(f"; {note}" for note in found.notes)
    unit = "pix of u, v" if found.unit == "pix" else found.unit
    head = (
        f"{output}: pixel area over that of {number(found.scale, 6)} {unit} squared "
        f"({found.scale_from}), by {found.name}{notes}"
    )
    return "\n".join([head, *(_line(one) for one in maps)])


def _line(one: PixelAreaMap) -> str:
    low, high = float(one.area.min()), float(one.area.max())
    text = (
        f"  chip {one.chip}: {low:.5f} to {high:.5f}, "
        f"{-2.5 * np.log10(low):+.4f} to {-2.5 * np.log10(high):+.4f} mag"
    )
    if one.sigma_magnitude is None:
        return text
    return f"{text}, known to {number(1e3 * float(one.sigma_magnitude.max()), 3)} mmag at worst"
