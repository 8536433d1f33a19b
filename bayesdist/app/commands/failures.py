"""Exit codes and messages for defects of the package and for limits of the machine."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import traceback
from pathlib import Path

from bayesdist.version import __version__

# as in sysexits.h: EX_SOFTWARE, EX_OSERR, EX_IOERR, EX_DATAERR
DEFECT, NO_MEMORY, NO_SYSTEM, TOO_DEEP = 70, 71, 74, 65


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
