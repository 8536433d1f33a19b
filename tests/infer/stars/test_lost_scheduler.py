"""Messages of a lost scheduler: one sentence, soon, no traceback, and not those of others."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from contextlib import closing
from types import SimpleNamespace

import pytest

from bayesdist.infer.stars.cluster import _without_messages

CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""
CLIENT = """
import sys, time
from bayesdist.errors import InputError
from bayesdist.infer import Compute
from bayesdist.infer.stars.cluster import ClusterPieces

def rest(piece, seconds):
    time.sleep(seconds)
    return piece

if __name__ == "__main__":
    pieces = ClusterPieces(float, ["1.5", "2.5"], Compute(engine="dask", scheduler=sys.argv[1]))
    print(pieces.sum(rest, 0.0), flush=True)
    try:
        pieces.sum(rest, 100.0)
    except InputError as error:
        print(error)
    finally:
        pieces.close()
"""
SOON = 60.0  # seconds: twice what distributed takes to give up a connection


def _started(script: str, *arguments: str) -> subprocess.Popen[str]:
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen([sys.executable, "-c", script, *arguments], text=True, **pipes)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_scheduler_is_killed_during_a_pass():
    cluster = _started(CLUSTER)
    try:
        address = cluster.stdout.readline().strip()
        client = _started(CLIENT, address)
        assert client.stdout.readline() == "4.0\n", client.stderr.read()
        time.sleep(0.5)  # the next pass has begun
        cluster.kill()
        killed = time.monotonic()
        out, err = client.communicate(timeout=2 * SOON)
        assert time.monotonic() - killed < SOON
    finally:
        cluster.kill()
        cluster.communicate()
    assert out == (
        f"cluster {address}: the connection to the scheduler is lost; restart it and the run.\n"
    )
    assert (client.returncode, err) == (0, "")


def test_the_handler_of_the_event_loop_is_restored():
    """The loop belongs to the client, which other code of the program may use as well."""
    told = []
    with closing(asyncio.new_event_loop()) as loop:
        loop.set_exception_handler(lambda _, context: told.append(context["message"]))
        with _without_messages(SimpleNamespace(loop=SimpleNamespace(asyncio_loop=loop))):
            loop.call_exception_handler({"message": "during the run"})
        loop.call_exception_handler({"message": "after it"})
    assert told == ["after it"]
