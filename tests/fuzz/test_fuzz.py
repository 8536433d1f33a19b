"""No damage to any input ends in a traceback, a hang, lost memory or a wrong number."""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import pytest

from tests.fuzz import sandbox
from tests.fuzz.__main__ import main
from tests.fuzz.cases import Case, kept
from tests.fuzz.inputs import Input
from tests.fuzz.mutation import MUTATIONS
from tests.fuzz.sandbox import Answer, answers
from tests.fuzz.verdicts import accepted, not_accepted

FEW, MANY = 20, 20_000


@pytest.fixture(scope="module")
def elsewhere():
    """A process that forks: this one may have threads of libraries that other tests use."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("NUMBA_THREADING_LAYER", "workqueue")
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            yield pool


@pytest.mark.slow
def test_damaged_input_is_answered_warned_of_or_refused(elsewhere, full, tmp_path, capsys):
    """Cases that are drawn, and those that failed once (reduced: one of each mutation)."""
    counts = tmp_path / "counts.json"
    given = ["--cases", str(MANY if full else FEW), "--json", str(counts)]
    elsewhere.submit(main, given).result()
    found = json.loads(counts.read_text("utf-8"))
    with capsys.disabled():
        print(f"\n{found['table']}")
    assert found["tried"] >= (MANY if full else FEW)
    assert not found["failed"], "\n".join(found["failed"])


# -- what counts the cases sees each kind of failure ----------------------------------------------


def became(case: Case, before: Answer, after: Answer) -> str:
    return not_accepted(after) or accepted(case, before, after)


@pytest.fixture
def one(tmp_path):
    (tmp_path / "a.csv").write_text("x,y\n1,2\n3,4\n5,6\n")
    return Input("a.csv", "stars", tmp_path, "a.csv", {"say": ["say", "@/a.csv"]})


def _raise(line):
    raise KeyError("x")


def _endless(line):
    time.sleep(100)


def _large(line):
    return bytearray(1 << 42)


def _said(line):
    print(Path(line[1]).read_text()[:9])


def _exits(line):
    os._exit(3)


def _answers_of(command, one):
    """Answers of a function in place of the command line, tried twice.

    What would never end is ended soon, and nothing else.
    """
    with (
        patch.object(sandbox, "main", lambda line: bool(command(line)) * 0),
        patch.object(sandbox, "WAIT", 0.2 if command is _endless else 20.0),
    ):
        return list(answers([(one, CASE, "say")] * 2))


CASE = Case("a.csv", "say", "cell_not_finite", {"line": 1, "cell": 0, "text": "nan"})


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (_raise, "traceback"),
        (_endless, "hang"),
        (_large, "memory"),
        (_said, "silent"),
        (_exits, "traceback"),
    ],
)
def test_each_kind_of_failure_is_seen(one, elsewhere, command, expected):
    found = elsewhere.submit(_answers_of, command, one).result()
    before = Answer("returned", 0, "x,y\n1,2\n3", "")
    assert [became(CASE, before, answer) for answer in found] == [expected] * 2


REFUSAL = "bayesdist: a.csv, row 1: value is nan; correct the row or drop it.\n"


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (Answer("returned", 1, "", REFUSAL), "refused"),
        (Answer("returned", 1, "", "bayesdist: 'NoneType' object has no attribute 'x'; do.\n"),
         "unclear"),
        (Answer("returned", 1, "", "bayesdist: a.csv: is wrong.\n"), "unclear"),
        (Answer("returned", 70, "", REFUSAL), "traceback"),
        (Answer("returned", 0, "rms 1", ""), "equal"),
        (Answer("returned", 0, "rms 2", "1 row left out\n"), "warned"),
        (Answer("returned", 0, "rms 2", ""), "silent"),
    ],
)  # fmt: skip
def test_what_a_command_says_is_judged(answer, expected):
    assert became(CASE, Answer("returned", 0, "rms 1", ""), answer) == expected


def test_numbers_that_nobody_can_know_to_be_others_are_no_failure():
    open_case = Case("a.csv", "say", "cell_odd", {})
    answer = Answer("returned", 0, "rms 2", "")
    assert became(open_case, Answer("returned", 0, "rms 1", ""), answer) == "other"


def test_a_mutation_leaves_the_file_alone_that_it_is_a_link_to(one):
    os.link(one.path, one.folder / "b.csv")
    MUTATIONS["cell_not_finite"].apply(one.folder / "b.csv", line=1, cell=0, text="nan")
    assert one.path.read_text() == "x,y\n1,2\n3,4\n5,6\n"
    assert (one.folder / "b.csv").read_text() == "x,y\nnan,2\n3,4\n5,6\n"


def test_kept_cases_name_mutations_that_there_are():
    assert {case.mutation for case in kept()} <= MUTATIONS.keys()
