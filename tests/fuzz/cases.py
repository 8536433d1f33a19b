"""Cases: a damaged file and a command, drawn by hypothesis, and kept as a line of JSON."""

from __future__ import annotations

import json
import random
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

from tests.fuzz import arrays, cards, raw, rows, trees  # noqa: F401 - they register mutations
from tests.fuzz.inputs import Input
from tests.fuzz.mutation import MUTATIONS

KEPT = Path(__file__).with_name("cases") / "failed.jsonl"


@dataclass(frozen=True)
class Case:
    """A command that reads a damaged file.

    Parameters
    ----------
    input, command, mutation : str
        Their names.
    arguments : dict
        Of the mutation.
    was : str
        For a kept case, what became of it once.
    """

    input: str
    command: str
    mutation: str
    arguments: dict[str, Any] = field(default_factory=dict)
    was: str = ""

    @property
    def line(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self))


def kept() -> list[Case]:
    """Cases that failed once."""
    if not KEPT.exists():
        return []
    return [Case(**json.loads(line)) for line in KEPT.read_text("utf-8").splitlines() if line]


@st.composite
def cases(draw, one: Input, suited) -> Case:
    """Strategy of cases of one input; `suited` are mutations with the strategy of arguments."""
    command = draw(st.sampled_from(sorted(one.commands)))
    kind = draw(st.sampled_from(sorted({MUTATIONS[name].kind for name in suited})))
    name = draw(st.sampled_from(sorted(n for n in suited if MUTATIONS[n].kind == kind)))
    return Case(one.name, command, name, draw(suited[name]))


def _suited(one: Input):
    content, form = one.path.read_bytes(), one.form
    found = {}
    for name, mutation in MUTATIONS.items():
        if mutation.suits(form):
            strategy = mutation.arguments(content)
            if strategy is not None:
                found[name] = strategy
    return found


def drawn(inputs: Iterable[Input], n: int, seed: int) -> list[Case]:
    """n cases, the same number of each input but for one, in any order."""
    out: list[Case] = []
    known = list(inputs)
    for k, one in enumerate(known):
        many = n * (k + 1) // len(known) - n * k // len(known)
        out += _of_input(one, many, seed + k)
    random.Random(seed).shuffle(out)  # an end before time has seen some of each
    return out


ENTRIES = (None, [], "abc")  # of no use in most places


def swept(inputs: Iterable[Input]) -> list[Case]:
    """Cases in which each entry of each JSON file is lost, or replaced by each of `ENTRIES`.

    Of a list only the first item is replaced.  Every command that reads the file is tried.
    """
    return [
        Case(one.name, command, mutation, arguments)
        for one in inputs
        if one.form == "json"
        for command in one.commands
        for at in trees.paths(json.loads(one.path.read_bytes()))
        if all(not isinstance(key, int) or key == 0 for key in at)
        for mutation, arguments in [
            ("entry_lost", {"at": at}),
            *(("entry_is", {"at": at, "value": value}) for value in ENTRIES),
        ]
    ]


def _of_input(one: Input, n: int, seed: int) -> list[Case]:
    found: list[Case] = []

    @seeded(seed)
    @settings(
        max_examples=n + 1,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(cases(one, _suited(one)))
    def collect(case: Case) -> None:
        found.append(case)

    if n:
        collect()
    return found[1 : n + 1]  # the first is always the simplest of all
