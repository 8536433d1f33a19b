"""Groups of commands that are loaded when first asked for, and options that commands share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from functools import wraps
from typing import Any

import click

from bayesdist.app.screen import start_logging
from bayesdist.errors import InputError
from bayesdist.mission import load_object


class LazyGroup(click.Group):
    """A group whose commands are named as "module:object"."""

    def __init__(self, name: str, *, help: str, lazy: Mapping[str, str], **options: Any) -> None:
        super().__init__(name, help=help, **options)
        self._lazy = lazy

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands."""
        return list(self._lazy)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Command of a name, loaded; None for an unknown one."""
        return self.load(self._lazy[cmd_name]) if cmd_name in self._lazy else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Command of the arguments; a name that is unknown is answered with similar ones."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            similar = get_close_matches(args[0], self.list_commands(ctx), n=2)
            if not similar or "Did you mean" in error.format_message():
                raise
            said = " or ".join(repr(name) for name in similar)
            raise click.UsageError(
                f"No such command {args[0]!r}. Did you mean {said}?", ctx
            ) from None

    @staticmethod
    def load(target: str) -> click.Command:
        """Command that "module:object" names."""
        command = load_object(target)
        if not isinstance(command, click.Command):
            raise InputError("is no command", where=target, do="mend the package that names it")
        return command


class CommaList(click.ParamType):
    """Values that are separated by commas."""

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


def command(
    calls: str = "", *, recorded: bool = False, **settings: Any
) -> Callable[[Callable[..., int | None]], click.Command]:
    """Decorator of a command, which takes --quiet.

    `calls`: as "module:function", what the command does: it is loaded when that runs, takes the
    options (and the command line, to be `recorded`), and returns what is printed.  Without it the
    decorated function does all by itself, and returns the exit code.
    """
    quiet = click.option(
        "-q",
        "--quiet",
        is_flag=True,
        expose_value=False,
        callback=lambda ctx, param, quiet: start_logging(quiet=quiet),
        help="Print only warnings and errors.",
    )

    def decorated(function: Callable[..., int | None]) -> click.Command:
        @wraps(function)
        def calling(**options: Any) -> None:
            if recorded:
                options["command"] = click.get_current_context().obj
            click.echo(load_object(calls)(**options))

        return click.command(**settings)(quiet(calling if calls else function))

    return decorated


ON_FILES, ON_RUNS = "bayesdist.app.commands.on_files", "bayesdist.app.commands.on_runs"
column_names = _ColumnNames()
new_folder = click.option(
    "-o", "--output", type=click.Path(), required=True, metavar="DIR", help="Folder to create."
)
force = click.option("--force", is_flag=True, help="Replace an existing output.")
seed = click.option(
    "--seed", type=click.IntRange(min=0), default=1, metavar="N", help="Seed of the random numbers."
)
epoch = click.option(
    "--epoch", type=float, metavar="T", help="Date in decimal years, for calibrations that drift."
)
filter_name = click.option("--filter", metavar="F", help="Filter of an IDCTAB, or WISE band.")
pixel_scale = click.option(
    "--scale", type=float, metavar="S", help="Size of a corrected pixel, arcsec."
)
image_size = click.option(
    "--size",
    nargs=2,
    type=float,
    metavar="NX NY",
    help="Size of the image in pixels, for a file that does not state it.",
)
