"""Groups of commands that are imported on first use, and options that commands share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import wraps
from typing import Any

import click

from bayesdist.app.screen import start_logging
from bayesdist.errors import InputError
from bayesdist.plugin import load_object


class LazyGroup(click.Group):
    """Group of commands that are imported on first use.

    Parameters
    ----------
    name : str
    help : str
        Help text of the group.
    lazy : mapping of str to str
        Location of each command as "module:object", by the name of the command.
    **options
        Passed to `click.Group`.
    """

    def __init__(self, name: str, *, help: str, lazy: Mapping[str, str], **options: Any) -> None:
        super().__init__(name, help=help, **options)
        self._lazy = lazy

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands."""
        return list(self._lazy)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load the command of a name; None if the name is unknown."""
        return self.load(self._lazy[cmd_name]) if cmd_name in self._lazy else None

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the epilog, by default the example of the first command."""
        if not self.epilog:
            first = self.get_command(ctx, self.list_commands(ctx)[0])
            self.epilog = None if first is None else first.epilog
        super().format_epilog(ctx, formatter)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Command of the arguments; the error for an unknown name suggests similar ones."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            similar = get_close_matches(args[0], self.list_commands(ctx), n=2)
            if not similar or "Did you mean" in error.format_message():
                raise
            suggestion = " or ".join(repr(name) for name in similar)
            raise click.UsageError(
                f"No such command {args[0]!r}. Did you mean {suggestion}?", ctx
            ) from None

    @staticmethod
    def load(target: str) -> click.Command:
        """Load the command at "module:object"."""
        try:
            command = load_object(target)
        except (ImportError, AttributeError) as error:
            if target.startswith("bayesdist."):
                raise
            raise InputError(
                f"the command cannot be imported ({error})",
                where=target,
                do="install its package again, or remove it",
            ) from error
        return LazyGroup.checked(command, target)

    @staticmethod
    def checked(command: object, where: str) -> click.Command:
        """Return the command; raises InputError if the object is not a command."""
        if not isinstance(command, click.Command):
            raise InputError(
                "is not a command", where=where, do="correct the package that registers it"
            )
        return command


class CommaList(click.ParamType):
    """Values separated by commas."""

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
    """Pairs KEY=NAME separated by commas."""

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
                    f"{key!r} is not KEY=NAME",
                    where="--columns",
                    do="write it in that form, as in x=XWIN_IMAGE",
                )
        return {key.strip(): name.strip() for key, _, name in pairs}


@dataclass(frozen=True)
class Unused:
    """Options that a command does not use in one of its modes, and refuses there.

    Attributes
    ----------
    names : str
        Parameter names of the options, separated by blanks.
    mode : str
        The mode in words, as "without --inverse".
    holds : callable
        From the values of all options, by parameter name, to True if the command is in this mode.
    do : str
        What to do instead of leaving the option out; empty if there is nothing else.
    """

    names: str
    mode: str
    holds: Callable[[Mapping[str, Any]], bool]
    do: str = ""

    def refuse(self, context: click.Context) -> None:
        """Raise click.UsageError if one of the options was given on the command line."""
        if not self.holds(context.params):
            return
        for parameter in context.command.params:
            name = parameter.name or ""
            if name not in self.names.split():
                continue
            if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
                instead = f", or {self.do}" if self.do else ""
                raise click.UsageError(
                    f"{parameter.opts[-1]} is not used {self.mode}: leave it out{instead}.", context
                )


class _Command(click.Command):
    """Command that refuses options that it does not use in the chosen mode."""

    unused: tuple[Unused, ...] = ()
    example: str = ""  # see `command`
    calls: str = ""  # see `command`

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, unless an option would be ignored."""
        for rule in self.unused:
            rule.refuse(ctx)
        return super().invoke(ctx)


def command(
    calls: str = "",
    *,
    example: str = "",
    recorded: bool = False,
    unused: Sequence[Unused] = (),
    **settings: Any,
) -> Callable[[Callable[..., int | None]], click.Command]:
    """Decorator for a command with the option --quiet.

    Parameters
    ----------
    calls : str
        Function that carries out the command, as "module:function".  It is imported when the
        command runs, receives the options, and returns the text to print.  If it is empty the
        decorated function does everything and returns the exit code.
    example : str
        Command line without 'bayesdist' that is shown at the end of the help.
    recorded : bool
        Pass the command line to the function, as its argument `command`.
    unused : sequence of Unused
        Options that are refused in some modes.
    **settings
        Passed to `click.command`.
    """
    quiet = click.option(
        "-q",
        "--quiet",
        is_flag=True,
        expose_value=False,
        callback=lambda ctx, param, quiet: start_logging(quiet=quiet),
        help="Print results, warnings and errors only, no messages on progress.",
    )

    def decorated(function: Callable[..., int | None]) -> click.Command:
        @wraps(function)
        def calling(**options: Any) -> None:
            if recorded:
                options["command"] = click.get_current_context().obj
            click.echo(load_object(calls)(**options))

        epilog = f"Example: bayesdist {example}" if example else None
        click_command = click.command(cls=_Command, epilog=epilog, **settings)(
            quiet(calling if calls else function)
        )
        click_command.unused, click_command.calls, click_command.example = (
            tuple(unused),
            calls,
            example,
        )
        return click_command

    return decorated


COMMANDS = "bayesdist.app.commands"
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
filter_name = click.option("--filter", metavar="F", help="Filter or band of a file with several.")
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
