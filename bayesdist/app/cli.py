"""Command line: all commands, and the conversion of errors to a sentence and an exit code.

Defects of the package and limits of the machine have exit codes of their own.
"""

from __future__ import annotations

import gc
import os
import platform
import shlex
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from bayesdist.app.commands.options import COMMANDS, LazyGroup
from bayesdist.app.screen import open_streams
from bayesdist.errors import BayesdistError, BayesdistWarning, RenamedError
from bayesdist.files.faults import InterruptHandler, installed_handler, raising_interrupts
from bayesdist.plugin import mission_objects, missions, plugins
from bayesdist.version import __version__

_LONGEST = 1000  # largest number of characters of a sentence
# thresholds of the garbage collector: imports create half a million permanent objects, and scanning
# them repeatedly takes a tenth of the time of a small run
SELDOM = 50_000, 20, 100
# commands use threads on all cores, which threads of the linear algebra would only slow down
ALGEBRA = "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"
INTERRUPTED, TERMINATED = 130, 143  # 128 and the number of the signal, as in a shell
CORE = {
    name: f"{COMMANDS}.{module}:{name.replace('-', '_')}"
    for module, names in {
        "runs": "check run stage report requirements budget plan select-order",
        "files": "monitor compare inspect apply convert docs",
    }.items()
    for name in names.split()
}
SIMULATED = {"camera": f"{COMMANDS}.files:camera"}
RENAMED = {
    **{name: f"stage {name}" for name in ("match", "fit", "sample", "assess", "export")},
    "validate": "requirements",
    "order": "select-order",
}
EPILOG = (
    "Exit codes: 0 success; 1 invalid input (the message states what to correct); 2 invalid "
    "command line; 3 the sampler did not converge and --strict was given; 4 a requirement is "
    "missed; 5 no requirement is missed, but one is not shown to be met; 6 a requirement is "
    "undecided because something is in doubt; 65 the input is nested too deeply; 70 a bug of "
    "bayesdist: please report it; 71 not enough memory; 74 a file cannot be read or written; "
    "130 interrupted by the user; 143 terminated by the system or a batch queue."
)

EXAMPLES = {
    "check": "check camera.toml",
    "run": "run camera.toml -o camera-run",
    "stage": "stage report camera-run --pdf",
    "report": "report camera-run other-run -o reports.html",
    "requirements": "requirements camera-run --requirements limits.toml",
    "budget": "budget camera-run --at 100 100 --to 1900 1900",
    "plan": "plan camera-run",
    "select-order": "select-order camera.toml --orders 2 6",
    "monitor": "monitor camera-run new_stars.csv",
    "compare": "compare camera-run old.hdr",
    "inspect": "inspect camera.hdr",
    "apply": "apply camera.hdr stars.csv -o sky.ecsv --sky",
    "convert": "convert camera.hdr --to tpv -o camera-tpv.hdr",
    "docs": "docs method",
}

# as in sysexits.h: EX_SOFTWARE, EX_OSERR, EX_IOERR, EX_DATAERR
DEFECT, NO_MEMORY, NO_SYSTEM, TOO_DEEP = 70, 71, 74, 65


def _renamed(name: str, new: str) -> RenamedError:
    """Error for a command that has been renamed."""
    return RenamedError(
        f"the command {name!r} has been renamed to {new!r}", do=f"use 'bayesdist {new}'"
    )


def _commands_of_plugins() -> dict[str, str]:
    """Locations of the commands of plugins as "module:object", by the name of the command."""
    others = {k: where for plugin in plugins().values() for k, where in plugin.commands.items()}
    return _first_commands() | others


def _first_commands() -> dict[str, str]:
    """Those commands of plugins that help lists before the commands of the core."""
    return {k: where for plugin in plugins().values() for k, where in plugin.first_commands.items()}


class _Root(LazyGroup):
    """Commands of the core, followed by those of plugins and of their missions."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        next_to_core = [name for mission in missions().values() for name in mission.beside_core]
        names = [*next_to_core, *_first_commands(), *super().list_commands(ctx)]
        later = [name for name in _commands_of_plugins() if name not in names]
        return [*names, *later, "simulate", *missions()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            if cmd_name in EXAMPLES:
                command.epilog = f"Example: bayesdist {EXAMPLES[cmd_name]}"
            return command
        if cmd_name in _commands_of_plugins():
            return self.load(_commands_of_plugins()[cmd_name])
        if cmd_name in RENAMED:
            raise _renamed(cmd_name, RENAMED[cmd_name])
        if cmd_name in missions():
            mission = missions()[cmd_name]
            return LazyGroup(cmd_name, help=mission.title, lazy=mission.commands)
        if cmd_name == "simulate":
            lazy = {k: v for mission in missions().values() for k, v in mission.simulate.items()}
            lazy = SIMULATED | lazy
            return LazyGroup("simulate", help="Simulate data of known truth.", lazy=lazy)
        beside_core = mission_objects(lambda mission: mission.beside_core, only=cmd_name)
        if cmd_name in beside_core:
            return self.checked(beside_core[cmd_name], cmd_name)
        for name, mission in missions().items():
            if cmd_name in mission.commands:
                raise _renamed(cmd_name, f"{name} {cmd_name}")
        return None

    def invoke(self, ctx: click.Context) -> int:
        # converted here, because click uses other exit codes for interrupts and closed pipes
        return _exit_code(lambda: super(_Root, self).invoke(ctx), ctx.obj or "bayesdist")


def _exit_code(call: Callable[[], int | None], command: str) -> int:
    """Exit code of a call; errors are printed as one sentence."""
    try:
        with raising_interrupts():
            return call() or 0
    except click.exceptions.Exit as end:  # after printing help
        return end.exit_code
    except click.ClickException as error:
        error.show(file=sys.stderr)
        return error.exit_code
    except BayesdistError as error:
        sentence = " ".join(str(error).split())  # messages of libraries may have several lines
        if len(sentence) > _LONGEST:  # it contains a long quotation
            sentence = f"{sentence[: _LONGEST // 2]} ... {sentence[-_LONGEST // 2 :]}"
        print(f"bayesdist: {sentence}", file=sys.stderr)
        return error.exit_code
    except (KeyboardInterrupt, click.Abort):
        handler = installed_handler()
        terminated = handler is not None and handler.terminated
        what, code = ("terminated", TERMINATED) if terminated else ("interrupted", INTERRUPTED)
        print(f"bayesdist: {what}; resume with --resume", file=sys.stderr)
        return code
    except BrokenPipeError:  # the reader of the pipe has closed it
        sys.stderr.close()
        return 0
    except Exception as error:  # not converted to a message at a lower level
        code, sentence = failure(error, command)
        print(f"bayesdist: {sentence}", file=sys.stderr)
        return code


bayesdist = click.version_option(__version__, message="bayesdist %(version)s")(
    _Root(
        "bayesdist",
        help="Calibrate the geometric distortion of a detector, with its uncertainty.",
        lazy=CORE,
        epilog=EPILOG,
        context_settings={"show_default": True, "help_option_names": ["-h", "--help"]},
    )
)


def program() -> int:
    """Run the command of the process, which ends with it."""
    handler = InterruptHandler()
    for number in (signal.SIGINT, signal.SIGTERM):  # a job in the background may ignore them
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, handler)
    sys.unraisablehook = handler.repeat_lost
    warnings.showwarning = _shown(warnings.showwarning)
    code = main()
    for number in (signal.SIGINT, signal.SIGTERM):  # Python closes what libraries have left open
        signal.signal(number, signal.SIG_IGN)
    return code


def _shown(default: Callable[..., None]) -> Callable[..., None]:
    """Function that prints warnings of bayesdist as one sentence, and others by `default`."""

    def show(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
        if issubclass(category, BayesdistWarning):
            print(f"bayesdist: WARNING: {message}", file=sys.stderr)
        else:
            default(message, category, *place, **options)

    return show


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    open_streams()
    gc.set_threshold(*SELDOM)
    for name in ALGEBRA:
        os.environ.setdefault(name, "1")
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    line = shlex.join(["bayesdist", *arguments])
    return _exit_code(
        lambda: bayesdist.main(arguments, prog_name="bayesdist", standalone_mode=False, obj=line),
        line,
    )


if __name__ == "__main__":
    sys.exit(program())


def failure(error: Exception, command: str) -> tuple[int, str]:
    """Exit code and sentence for an exception that was not handled at a lower level."""
    if isinstance(error, MemoryError):
        return NO_MEMORY, (
            "the memory of this machine is not enough; give fewer stars, draws or grid points, or "
            "use a machine with more."
        )
    if isinstance(error, OSError):  # refused by the operating system
        prefix = f"{error.filename}: " if error.filename else ""
        reason = str(error.strerror or error).rstrip(".")
        return NO_SYSTEM, f"{prefix}{reason}; check the path, the disk and your permissions."
    traceback_file = _written(error, command)
    report = "could not be written" if traceback_file is None else f"is in {traceback_file}"
    if isinstance(error, RecursionError):
        return TOO_DEEP, (
            "something is nested too deep to be followed; check the file that was read, and if it "
            f"is as it should be, report a defect: the traceback {report}."
        )
    first = " ".join(str(error).split())[:160].rstrip(".")
    defect = f"{type(error).__name__}: {first}" if first else type(error).__name__
    return DEFECT, (
        f"this is a defect of bayesdist, whatever the input ({defect}); please report it, with the "
        f"command and its input if you may: the traceback {report}."
    )


def _written(error: Exception, command: str) -> Path | None:
    """Write the traceback to a file in the current or the temporary folder; None if impossible."""
    text = "\n".join(
        [
            f"command   {command}",
            f"bayesdist {__version__}",
            f"python    {sys.version.split()[0]}, {platform.platform()}",
            "",
            "".join(traceback.format_exception(error, limit=-40)),
        ]
    )
    for folder in (".", tempfile.gettempdir()):
        try:
            handle, name = tempfile.mkstemp(".txt", "bayesdist-error-", folder, text=True)
            with os.fdopen(handle, "w", encoding="utf-8", errors="replace") as stream:
                stream.write(text)
        except OSError:
            continue
        return Path(name).absolute()
    return None
