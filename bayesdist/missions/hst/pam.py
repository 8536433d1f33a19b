"""`bayesdist hst pam`: pixel area maps of a calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesdist.app.commands.on_files.calibrations import calibration_of_scale, images_of, notes_of
from bayesdist.app.screen import number
from bayesdist.app.store.output import refuse_existing
from bayesdist.calibration.apply import FULL
from bayesdist.calibration.area import PixelAreaMap, pixel_area_map
from bayesdist.errors import InputError
from bayesdist.products.maps_file import write_pam


def write_area_maps(
    path: str | Path,
    output: str | Path,
    *,
    chip: int | None,
    filter: str | None,
    epoch: float | None,
    scale: float | None,
    image: str | Path | None,
    force: bool,
) -> str:
    """Write the pixel area maps of a calibration; returns text to print.

    With an image, the maps are made for its subarrays, in the order of its chips.
    """
    output = Path(output)
    if output.suffix.lower() != ".fits":
        raise InputError(
            f"extension {output.suffix!r} is not that of a FITS file",
            where=str(output),
            do="choose a name that ends in .fits",
        )
    refuse_existing(output, force)
    calibration = calibration_of_scale(path, filter=filter, scale=scale, epoch=epoch)
    chips, (pixel, source) = calibration.in_frame(epoch), calibration.pixel(epoch)
    images = images_of(calibration, image=image)
    numbers = list(images or chips)
    if chip is not None:
        if chip not in numbers:
            raise InputError(
                f"there is no chip {chip}",
                where=calibration.name,
                do=f"choose one of {', '.join(map(str, numbers))}",
            )
        numbers = [chip]
    maps = [pixel_area_map(chips[n], pixel, image=images.get(n, FULL)) for n in numbers]
    write_pam(
        output,
        maps,
        instrument=calibration.instrument,
        detector=calibration.detector,
        source=calibration.name,
    )
    notes = "".join(f"; {note}" for note in notes_of(calibration, epoch))
    unit = "pix of u, v" if calibration.unit == "pix" else calibration.unit
    head = (
        f"{output}: pixel area over that of {number(pixel, 6)} {unit} squared "
        f"({source}), by {calibration.name}{notes}"
    )
    return "\n".join([head, *(_line(area_map) for area_map in maps)])


def _line(one: PixelAreaMap) -> str:
    low, high = float(one.area.min()), float(one.area.max())
    text = (
        f"  chip {one.chip}: {low:.5f} to {high:.5f}, "
        f"{-2.5 * np.log10(low):+.4f} to {-2.5 * np.log10(high):+.4f} mag"
    )
    if one.sigma_magnitude is None:
        return text
    return f"{text}, known to {number(1e3 * float(one.sigma_magnitude.max()), 3)} mmag at worst"
