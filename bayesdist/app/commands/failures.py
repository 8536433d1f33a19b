"""What is neither a result nor an error of the user's: a defect, or a machine at its limits."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import traceback
from pathlib import Path

from bayesdist.version import __version__

# as sysexits.h has them: EX_SOFTWARE, EX_OSERR, EX_IOERR, EX_DATAERR
DEFECT, NO_MEMORY, NO_SYSTEM, TOO_DEEP = 70, 71, 74, 65


def failure(error: Exception, command: str) -> tuple[int, str]:
    """Exit code and sentence for an exception that nobody below could say more about."""
    if isinstance(error, MemoryError):
        return NO_MEMORY, (
            "the memory of this machine is not enough; give fewer stars, draws or grid points, or "
            "use a machine with more."
        )
    if isinstance(error, OSError):  # the system refuses
        where = f"{error.filename}: " if error.filename else ""
        reason = str(error.strerror or error).rstrip(".")
        return NO_SYSTEM, f"{where}{reason}; check the path, the disk and your permissions."
    found = _written(error, command)
    report = "could not be written" if found is None else f"is in {found}"
    if isinstance(error, RecursionError):
        return TOO_DEEP, (
            "something is nested too deep to be followed; check the file that was read, and if it "
            f"is as it should be, report a defect: the traceback {report}."
        )
    first = " ".join(str(error).split())[:160].rstrip(".")
    what = f"{type(error).__name__}: {first}" if first else type(error).__name__
    return DEFECT, (
        f"this is a defect of bayesdist, whatever the input ({what}); please report it, with the "
        f"command and its input if you may: the traceback {report}."
    )


def _written(error: Exception, command: str) -> Path | None:
    """File with the traceback, in the current folder or else in that for temporary files."""
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
