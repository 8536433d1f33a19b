"""A lock on a folder: one process at a time, and none when that is killed."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from bayesdist.app.store.store import LOCK, locked
from bayesdist.errors import InputError

pytest.importorskip("fcntl", reason="this system knows no such locks")

HOLDER = """
import sys, time
from pathlib import Path
from bayesdist.app.store.store import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def refusal(folder) -> str:
    with pytest.raises(InputError) as found, locked(folder):
        pass
    return str(found.value)


def test_a_second_process_is_told_of_the_first_and_takes_over_when_that_is_killed(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        said = refusal(tmp_path)
        assert f"process {holder.pid} on {socket.gethostname()} since " in said
        assert str(tmp_path) in said
        holder.kill()
    assert (tmp_path / LOCK).exists()  # what a killed process leaves holds nobody up
    with locked(tmp_path):
        assert f"process {os.getpid()} on" in refusal(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_a_lock_says_of_its_holder_is_one_line_at_most(tmp_path):
    with locked(tmp_path):
        (tmp_path / LOCK).write_bytes(b"\x1b[2Jprocess\n\xff" + 10_000 * b"z")
        said = refusal(tmp_path)
    assert "\n" not in said and "\x1b" not in said and len(said) < 600


def test_a_folder_that_is_not_there_is_made(tmp_path):
    with locked(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b" / LOCK).is_file()


def test_a_lock_that_was_removed_meanwhile_is_taken_anew(tmp_path):
    """Whoever waits for a file that its holder then removes must not hold that nameless file."""
    with locked(tmp_path):
        (tmp_path / LOCK).unlink()
        with locked(tmp_path):  # another file of this name: nobody else holds it
            assert (tmp_path / LOCK).is_file()
    with locked(tmp_path):
        assert refusal(tmp_path)
