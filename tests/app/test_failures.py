"""What nobody foresaw ends in one sentence and a code of its own, never in a traceback."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import pytest

from bayesdist.app import cli as commands
from bayesdist.files.faults import InterruptHandler, deferred_interrupts, raising_interrupts
from tests.app.support import cli

ERRORS = [
    (IndexError("list index out of range"), 70, "IndexError: list index out of range"),
    (AssertionError(), 70, "(AssertionError)"),
    (MemoryError(), 71, "the memory of this machine is not enough"),
    (PermissionError(13, "Permission denied", "a.fits"), 74, "a.fits: Permission denied"),
    (OSError("the disk is gone"), 74, "the disk is gone; check"),
]


def _failing(monkeypatch, error: BaseException) -> None:
    @click.command()
    def fails() -> None:
        raise error

    monkeypatch.setattr(commands.LazyGroup, "load", staticmethod(lambda target: fails))


@pytest.mark.parametrize(("error", "code", "words"), ERRORS)
def test_an_exception_of_any_kind(tmp_path, monkeypatch, error, code, words):
    monkeypatch.chdir(tmp_path)
    _failing(monkeypatch, error)
    result = cli("inspect")
    assert (result.code, result.out, result.err.count("\n")) == (code, "", 1)
    assert words in result.err and "Traceback" not in result.err
    written = list(tmp_path.iterdir())
    assert len(written) == (code == 70)
    for path in written:
        assert str(path) in result.err and "please report it" in result.err
        text = path.read_text()
        assert "Traceback" in text and type(error).__name__ in text
        assert text.startswith("command   bayesdist inspect\nbayesdist ")


def test_an_error_that_comes_of_an_interrupt_is_one(tmp_path, monkeypatch):
    """As when a file that is interrupted while it is made cannot be closed."""

    class HalfMade:
        def __enter__(self) -> None:
            raise KeyboardInterrupt

    @click.command()
    def fails() -> None:
        half = HalfMade()
        try:
            half.__enter__()
        finally:
            half.close()  # type: ignore[attr-defined]

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands.LazyGroup, "load", staticmethod(lambda target: fails))
    result = cli("inspect")
    assert (result.code, result.err) == (130, "bayesdist: interrupted; resume with --resume\n")
    assert not list(tmp_path.iterdir())


@contextmanager
def _handled(handler: InterruptHandler) -> Iterator[None]:
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@raising_interrupts()
def _fail_after(event: Callable[[], None]) -> None:
    event()
    raise AttributeError


def test_a_second_interrupt_leaves_the_first_one_to_its_end():
    with _handled(InterruptHandler()):
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        # a library that swallows it, and fails for that
        with pytest.raises(KeyboardInterrupt):
            _fail_after(lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(AttributeError):
            _fail_after(lambda: None)
    with _handled(InterruptHandler(again=0.0)):
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)


OPEN = {
    "in the destructor": "def __del__(self): signal.raise_signal(signal.{})",
    "half-made": (
        "def __init__(self): signal.raise_signal(signal.{}); self.closed = False\n"
        "    def __del__(self): assert self.closed"
    ),
}


@pytest.mark.parametrize("how", OPEN)
def test_an_interrupt_is_not_lost_and_leaves_one_sentence(how):
    """Python prints exceptions in destructors and goes on."""
    code = (
        "import signal, sys, time, click\n"
        "from bayesdist.app import cli\n"
        # jobs in the background inherit that SIGINT is ignored
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Open:\n"
        f"    {OPEN[how]}\n"
        "@click.command()\n"
        "def fails():\n"
        "    Open(); time.sleep(60)\n"
        "cli.LazyGroup.load = staticmethod(lambda target: fails)\n"
        "sys.argv[1:] = ['inspect']; sys.exit(cli.program())"
    )
    for name, exit_code, word in (("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")):
        ended = subprocess.run(
            [sys.executable, "-c", code.format(name)], capture_output=True, text=True, timeout=50
        )
        said = f"bayesdist: {word}; resume with --resume\n"
        assert (ended.returncode, ended.stderr) == (exit_code, said)


def test_an_interrupt_waits_for_what_cannot_be_interrupted():
    ends = list[str]()

    def write() -> None:
        with deferred_interrupts():
            signal.raise_signal(signal.SIGINT)
            ends.append("written")

    with _handled(InterruptHandler()):
        with pytest.raises(KeyboardInterrupt):
            write()
        with deferred_interrupts():
            ends.append("again")
    assert ends == ["written", "again"]


def test_an_interrupt_while_python_ends_is_silent():
    """The command has ended, and nothing is left to interrupt."""
    code = (
        "import atexit, signal, sys; from bayesdist.app.cli import program\n"
        "atexit.register(signal.raise_signal, signal.SIGINT); sys.exit(program())"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, "--version"], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("bayesdist ")


def test_endless_recursion(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    @click.command()
    def deeper() -> None:
        def down(n: int) -> int:
            return down(n + 1) + 1

        down(0)

    monkeypatch.setattr(commands.LazyGroup, "load", staticmethod(lambda target: deeper))
    result = cli("inspect")
    assert result.code == 65 and "nested too deep" in result.err
    [path] = tmp_path.iterdir()
    assert str(path) in result.err and path.stat().st_size < 20_000


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_where_the_current_folder_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "closed").mkdir()
    (tmp_path / "open").mkdir()
    monkeypatch.chdir(tmp_path / "closed")
    (tmp_path / "closed").chmod(stat.S_IRUSR | stat.S_IXUSR)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "open"))
    _failing(monkeypatch, KeyError("x"))
    assert str(tmp_path / "open") in cli("inspect").err


def test_the_codes_are_in_the_documentation_and_the_help():
    root = Path(__file__).parents[2]
    text = (root / "docs" / "commands.md").read_text(encoding="utf-8")
    for _, code, _ in [*ERRORS, (None, 65, ""), (None, 130, ""), (None, 143, "")]:
        assert f"\n| {code} |" in text
        assert f" {code} " in commands.EPILOG
