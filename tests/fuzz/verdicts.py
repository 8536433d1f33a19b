"""What became of a case, and how many of each kind there are."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from bayesdist.app.cli import DEFECT, NO_MEMORY, NO_SYSTEM, TOO_DEEP
from tests.fuzz.cases import Case
from tests.fuzz.inputs import Input
from tests.fuzz.mutation import HARMLESS, KNOWABLE, MUTATIONS, OPEN
from tests.fuzz.sandbox import Answer, PlainAnswers, answers

GOOD = ("refused", "warned", "equal", "other")
BAD = ("unclear", "traceback", "hang", "memory", "silent")
REFUSED = (1, 2, 3, NO_SYSTEM)
TITLES = {
    "refused": "refused with a sentence",
    "warned": "warned",
    "equal": "accepted, equal",
    "other": "accepted, other numbers as the file has",
    "unclear": "refused in no clear sentence",
    "traceback": "traceback",
    "hang": "hang",
    "memory": "memory",
    "silent": "changed number without a warning",
}
# of exceptions that were meant for programmers
PYTHON = re.compile(
    r"Traceback|NoneType|object has no|not subscriptable|not iterable|index out of|out of bounds"
    r"|unhashable|\b(Key|Type|Value|Attribute|Index|Assertion|Recursion|Overflow|NotImplemented)"
    r"Error\b|unexpected keyword|positional argument|not supported between|<class|has no attribute"
    r"|broadcast|maximum recursion|unpack|expected str, bytes|must be real number|required argument"
)
NO_ROOM = re.compile(r"MemoryError|[Uu]nable to allocate|[Cc]annot allocate|malloc of size")
WARNING = re.compile(
    r"warn|reject|left out|not here|ignored|skipped|error:|note:|does not|no value|missing|masked"
    r"|have no motion"
    r"|again, as|incomplete|not as|degenerate|damaged|faults|not converged|GUESSED|LOOK",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Verdict:
    """What became of a case: a key of TITLES, and why."""

    case: Case
    kind: str
    became: str
    answer: Answer

    @property
    def failed(self) -> bool:
        return self.became in BAD

    @property
    def told(self) -> str:
        """The failure in a few lines."""
        last = [line for line in self.answer.err.splitlines() if line.strip()][-4:]
        if self.became == "silent":
            last = self.answer.out.splitlines()[:6]
        return f"{self.became}: {self.case.line}\n    " + "\n    ".join(last)


def tried(inputs: Sequence[Input], cases: Iterable[Case]) -> Iterator[Verdict]:
    """Verdicts of cases; an answer is compared with that to the file as it was."""
    known, plain = {one.name: one for one in inputs}, PlainAnswers()
    cases = [c for c in cases if c.input in known and c.command in known[c.input].commands]
    found = answers([(known[c.input], c, c.command) for c in cases])
    for c, answer in zip(cases, found, strict=True):
        one = known[c.input]
        if answer.end == "hang":  # unless kernels were compiled, which the plain file needs as well
            plain.of(one, c.command)
            [answer] = answers([(one, c, c.command)])
        end = not_accepted(answer) or accepted(c, plain.of(one, c.command), answer)
        yield Verdict(c, one.kind, end, answer)


def not_taken(inputs: Sequence[Input]) -> Iterator[str]:
    """Commands that refuse an input that is not damaged, so that no damage to it is tried."""
    plain = PlainAnswers()
    for one in inputs:
        for command in one.commands:
            answer = plain.of(one, command)
            if answer.end != "returned" or answer.code in (*REFUSED, DEFECT, NO_MEMORY):
                yield f"{one.name}, {command}: {answer.err.strip()}"


def not_accepted(answer: Answer) -> str:
    """Key of TITLES, where a command did not take its input; '' where it did."""
    if answer.end in ("hang", "memory"):
        return answer.end
    if answer.code == NO_MEMORY or NO_ROOM.search(answer.err):
        return "memory"
    if answer.end != "returned" or answer.code in (DEFECT, TOO_DEEP):
        return "traceback"
    if answer.code in REFUSED:
        return "refused" if answer.code == 2 or is_sentence(answer.err) else "unclear"
    return ""


def accepted(case: Case, before: Answer, after: Answer) -> str:
    """Key of TITLES, where a command took its input."""
    if (after.code, after.out) == (before.code, before.out):
        return "equal"
    if _warnings(after) - _warnings(before):
        return "warned"
    effect = MUTATIONS[case.mutation].effect
    assert effect in (HARMLESS, KNOWABLE, OPEN)
    return "other" if effect == OPEN else "silent"


def is_sentence(err: str) -> bool:
    """Boolean: the last line is ours, says what to do, and is no exception's of Python."""
    lines = [line for line in err.splitlines() if line.startswith("bayesdist: ")]
    if len(lines) != 1 or err.splitlines()[-1] != lines[0]:
        return False
    line = lines[0]
    return line.endswith(".") and "; " in line and not PYTHON.search(line) and len(line) < 1500


def _warnings(answer: Answer) -> set[str]:
    """Lines that say that something is amiss."""
    lines = [*answer.err.splitlines(), *answer.out.splitlines()]
    return {line for line in lines if WARNING.search(line)}


def table_of(verdicts: Sequence[Verdict], label=lambda v: v.kind) -> str:
    """Counts as a table of Markdown."""
    kinds = list(dict.fromkeys(label(v) for v in verdicts))
    counts = Counter((label(v), v.became) for v in verdicts)
    heads = ["kind of input", "tried", *TITLES.values()]
    lines = [" | ".join(heads), " | ".join("---" for _ in heads)]
    for kind in [*kinds, "all"]:
        n = [
            sum(m for (k, b), m in counts.items() if kind in (k, "all") and b == one)
            for one in TITLES
        ]
        lines.append(" | ".join(map(str, [kind, sum(n), *n])))
    return "\n".join(f"| {line} |" for line in lines)
