"""Format of FITS tables of parameters and their covariance."""

from __future__ import annotations

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError
from bayesdist.products.common.content import Content, Hdu
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Format,
    FormatSettings,
    finding_lines,
)
from bayesdist.products.common.parameters import (
    parameters_content,
    stored_calibration,
    stored_in,
)

KIND = "table of parameters"


class ParametersSettings(FormatSettings):
    """Configuration of a table of parameters, which has no options."""


def _parse(content: Content) -> tuple[str, Hdu] | None:
    """Name and table HDU of a file that holds only a parameter table; None for any other file."""
    hdu = stored_in(content)
    if hdu is None or not hdu.number == len(content.tables) - 1 == 1:
        return None
    return content.name, hdu


def _describe(table: tuple[str, Hdu]) -> list[str]:
    """Lines of text on the table."""
    name, hdu = table
    calibration = stored_calibration(hdu, name)
    chips = ", ".join(
        f"{c.number} ({c.size[0]:g} x {c.size[1]:g} px)" for c in calibration.model.chips
    )
    return [
        f"{name}: parameters of a calibration, by bayesdist",
        f"  order     {calibration.model.order}, u and v in {calibration.unit}",
        f"  chips     {chips}",
        f"  errors    {calibration.errors}",
        "",
        *finding_lines(()),
    ]


def build(
    calibration: Calibration, _: ParametersSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build one FITS file with all chips at one date; InputError for look-up tables."""
    if calibration.before or calibration.after:
        raise InputError(
            "a table of parameters has no look-up tables",
            where="products.parameters",
            do="give the order of a polynomial that replaces them",
        )
    content = parameters_content(calibration, options.epoch)
    return (Built(options.named("parameters.fits"), KIND, content, calibration),)


FORMAT = Format(
    "parameters",
    "a table of parameters by bayesdist",
    30,
    _parse,
    _describe,
    calibration=lambda table, name, _: stored_calibration(table[1], name),
    settings=ParametersSettings,
    build=build,
)
