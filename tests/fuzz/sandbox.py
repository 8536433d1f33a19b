"""Commands in forked processes with little memory and time, many cases in each."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import re
import resource
import select
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from bayesdist.app.cli import main
from tests.fuzz.cases import Case
from tests.fuzz.inputs import HERE, Input
from tests.fuzz.mutation import MUTATIONS
from tests.sketches import sketched

SECONDS = 20.0  # of processor time
WAIT = 120.0  # seconds of the clock: the machine may be busy
MEMORY = 2 << 30  # beyond what the process has mapped when it begins
BATCH = 40
# answers that depend on the machine, or count rows
TIMES = re.compile(r"^cost .*$|\d+(\.\d+)? (s|ms|min)\b.*$|\d+ positions", re.MULTILINE)
POSITIONS = "out.csv"  # of `apply`


@dataclass(frozen=True)
class Answer:
    """What a command did.

    Parameters
    ----------
    end : str
        'returned', 'raised', 'hang', 'memory' or 'died'.
    code : int
    out, err : str
        In which the folder is HERE; `out` with the content of the files that were written.
    seconds : float
    """

    end: str
    code: int = 0
    out: str = ""
    err: str = ""
    seconds: float = 0.0


class _Overdue(BaseException):
    """The alarm; no handler of exceptions may take it for one."""


def _ring(*_: object) -> None:
    raise _Overdue


def answers(pairs: Sequence[tuple[Input, Case, str]]) -> Iterator[Answer]:
    """Answers of commands to inputs that are damaged by a case, as they come."""
    n = 0
    while n < len(pairs):
        some = _batch(pairs[n : n + BATCH])
        yield from some
        n += len(some)


def _batch(pairs: Sequence[tuple[Input, Case, str]]) -> list[Answer]:
    """Answers up to the first case that ends its process, or all."""
    here, there = os.pipe()
    folder = Path(tempfile.mkdtemp(prefix="bayesdist-fuzz-"))
    child = os.fork()
    if not child:
        os.close(here)
        os.setsid()
        _child(pairs, folder, there)
    os.close(there)
    found, end = _collected(here, child, len(pairs))
    os.close(here)
    shutil.rmtree(folder, ignore_errors=True)
    if len(found) < len(pairs):
        found.append(Answer(end))
    return found


def _collected(pipe: int, child: int, n: int) -> tuple[list[Answer], str]:
    """Answers as they come, and how the process ended that left some out."""
    text, found, end = b"", list[Answer](), "died"
    while len(found) < n:
        ready, _, _ = select.select([pipe], [], [], WAIT + 30)
        if not ready:  # deaf to the alarm
            end = "hang"
            break
        read = os.read(pipe, 1 << 20)
        if not read:
            break
        *lines, text = (text + read).split(b"\n")
        found += [Answer(**json.loads(line)) for line in lines]
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return found, end


def _child(pairs: Sequence[tuple[Input, Case, str]], folder: Path, pipe: int) -> None:
    """Answers into a pipe; the end of the process."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for alarm in (signal.SIGALRM, signal.SIGPROF):
            signal.signal(alarm, _ring)
        for stream in (0, 1, 2):
            os.dup2(os.open(os.devnull, os.O_RDWR), stream)
        os.chdir(folder)
        with sketched():
            for k, (one, case, command) in enumerate(pairs):
                answer = _answer(one, case, command, folder / str(k), alarmed=True)
                os.write(pipe, json.dumps(asdict(answer)).encode() + b"\n")
    finally:
        os._exit(0)


def _answer(
    one: Input, case: Case | None, command: str, copy: Path, *, alarmed: bool = False
) -> Answer:
    _copied(one, copy)
    if case is not None:
        MUTATIONS[case.mutation].apply(copy / one.file, **case.arguments)
    arguments = [part.replace(HERE, str(copy)) for part in one.commands[command]]
    out, err = io.StringIO(), io.StringIO()
    end, code, begun = "returned", 0, time.process_time()
    if alarmed:
        signal.setitimer(signal.ITIMER_REAL, WAIT)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(arguments)
    except _Overdue:
        end = "hang"
        traceback.print_exc(limit=-12, file=err)
    except MemoryError:
        end = "memory"
        traceback.print_exc(limit=-12, file=err)
    except (Exception, SystemExit):
        end = "raised"
        traceback.print_exc(limit=-12, file=err)
    finally:
        for timer in (signal.ITIMER_REAL, signal.ITIMER_PROF):
            signal.setitimer(timer, 0)
    seconds = time.process_time() - begun
    for path in Path().glob("bayesdist-error-*.txt"):  # a defect, of which the screen says less
        err.write("\n".join(path.read_text("utf-8").splitlines()[-16:]))
        path.unlink()
    texts = [out.getvalue(), *(_text(copy / name) for name in one.outputs)]
    said, wrong = ("\n".join(texts), err.getvalue())
    found = [TIMES.sub("", text.replace(str(copy), HERE)) for text in (said, wrong)]
    shutil.rmtree(copy, ignore_errors=True)
    return Answer(end, code, *found, seconds)


def _text(path: Path) -> str:
    if not path.is_file() or path.is_symlink():
        return ""
    text = path.read_text("utf-8", "replace")
    return _computed(text) if path.name == POSITIONS else text


def _computed(text: str) -> str:
    """Rows of `apply` by what it has computed, each once.

    Its other columns are copies, and a position that stands twice is computed twice.
    """
    rows = list(csv.DictReader(line for line in text.splitlines() if line[:1] != "#"))
    names = [name for name in (rows[0] if rows else ()) if name and "_out" in name]
    return "\n".join(sorted({" ".join(row[name] or "" for name in names) for row in rows}))


def _copied(one: Input, copy: Path) -> None:
    """Copy of a folder: files that nothing writes into are linked."""
    shutil.copytree(one.folder, copy, copy_function=_linked)


def _linked(source: str, target: str) -> None:
    if source.endswith((".log", ".json", ".toml")):
        shutil.copy(source, target)
    else:
        os.link(source, target)


class PlainAnswers:
    """Answers of commands to inputs as they are.

    They are found in this process, so that processes which are forked later need not load anew what
    the commands need.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[Path, tuple[str, ...]], Answer] = {}

    def of(self, one: Input, command: str) -> Answer:
        """Answer to an input."""
        key = one.folder, (*one.commands[command],)
        if key not in self._known:
            with (
                tempfile.TemporaryDirectory(prefix="bayesdist-fuzz-") as folder,
                contextlib.chdir(folder),
                sketched(),
            ):
                self._known[key] = _answer(one, None, command, Path(folder) / "copy")
        return self._known[key]
