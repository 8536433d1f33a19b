"""Options that commands have in common: quiet ones, lists, files that may be replaced."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

from bayesdist.app.screen import start_logging
from bayesdist.errors import InputError

__all__ = [
    "CommaList",
    "column_names",
    "command",
    "epoch",
    "filter_name",
    "force",
    "image_size",
    "new_folder",
    "pixel_scale",
    "seed",
]


class CommaList(click.ParamType):
    """Values that are separated by commas.

    Parameters
    ----------
    kind : type
        Of each value.
    """

    name = "list"

    def __init__(self, kind: type = str) -> None:
        self.kind = click.types.convert_type(kind)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        """Tuple of the values."""
        parts = value.split(",") if isinstance(value, str) else value
        return tuple(self.kind.convert(part.strip(), param, ctx) for part in parts)


class _ColumnNames(click.ParamType):
    """Pairs KEY=NAME that are separated by commas."""

    name = "columns"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Mapping[str, str]:
        """Mapping of key to name."""
        if not isinstance(value, str):
            return dict(value)
        pairs = [part.partition("=") for part in value.split(",")]
        for key, mark, _ in pairs:
            if not mark or not key.strip():
                raise InputError(
                    f"{key!r} is not KEY=NAME", where="--columns", do="write it so, as x=XWIN_IMAGE"
                )
        return {key.strip(): name.strip() for key, _, name in pairs}


def _begin_logging(ctx: click.Context, param: click.Parameter, quiet: bool) -> None:
    start_logging(-1 if quiet else 0)


def command(**settings: Any) -> Callable[[Callable[..., int | None]], click.Command]:
    """Decorator of a command, which takes --quiet; what it returns is the exit code."""
    quiet = click.option(
        "-q",
        "--quiet",
        is_flag=True,
        expose_value=False,
        callback=_begin_logging,
        help="Only warnings and errors.",
    )
    return lambda function: click.command(**settings)(quiet(function))


column_names = _ColumnNames()
new_folder = click.option("-o", "--output", required=True, metavar="DIR", help="A new folder.")
force = click.option("--force", is_flag=True, help="Replace what is there.")
seed = click.option("--seed", type=click.IntRange(min=0), default=1, metavar="N")
epoch = click.option("--epoch", type=float, metavar="T", help="Decimal years, for what drifts.")
filter_name = click.option("--filter", metavar="F", help="Of an IDCTAB, or a WISE band.")
pixel_scale = click.option("--scale", type=float, metavar="S", help="Of a corrected pixel.")
image_size = click.option(
    "--size", nargs=2, type=float, metavar="NX NY", help="Pixels, for a file that does not say."
)
