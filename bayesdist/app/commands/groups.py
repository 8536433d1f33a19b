"""Groups of commands that are loaded when they are first asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from bayesdist.errors import InputError
from bayesdist.mission import load_object

__all__ = ["LazyGroup"]


class LazyGroup(click.Group):
    """A group whose commands are named as "module:object".

    Parameters
    ----------
    name : str
    help : str
    lazy : mapping of str to str
    """

    def __init__(self, name: str, *, help: str, lazy: Mapping[str, str], **options: Any) -> None:
        super().__init__(name, help=help, **options)
        self._lazy = lazy

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands."""
        return list(self._lazy)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Command of a name, loaded; None for an unknown one."""
        return self.load(self._lazy[cmd_name]) if cmd_name in self._lazy else None

    @staticmethod
    def load(target: str) -> click.Command:
        """Command that "module:object" names."""
        command = load_object(target)
        if not isinstance(command, click.Command):
            raise InputError("is no command", where=target, do="mend the package that names it")
        return command
