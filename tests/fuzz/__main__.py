"""Draw cases, count what became of them, and write down those that failed."""

from __future__ import annotations

import argparse
import contextlib
import json
import resource
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz.cases import drawn, kept, swept
from tests.fuzz.inputs import inputs
from tests.fuzz.mutation import MUTATIONS
from tests.fuzz.verdicts import not_taken, table_of, tried

BEGUN = 1000  # cases, from which on runs are begun for them
SHORT = 100  # cases: with fewer, one of those that failed once is tried for each mutation


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 1 where a case failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="inputs whose name or kind has this in it")
    parser.add_argument("--kept", action="store_true", help="only the cases that failed once")
    parser.add_argument("--swept", action="store_true", help="every entry of every JSON file")
    parser.add_argument("--part", default="1/1", help="K/N: the K-th of N parts of these cases")
    parser.add_argument("--failed", metavar="FILE", help="write the cases that failed")
    parser.add_argument("--json", metavar="FILE", help="write counts and failures")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="bayesdist-fuzz-") as folder:
        made = inputs(Path(folder), begun=given.cases >= BEGUN or bool(given.only))
        known = [one for one in made if given.only in f"{one.kind} {one.name}"]
        refused = list(not_taken(known)) if given.cases >= BEGUN and not given.kept else []
        print(*refused, sep="\n", file=sys.stderr, flush=True)
        cases = kept()
        if given.cases < SHORT and not given.kept:
            cases = list({case.mutation: case for case in cases}.values())
        if given.swept:
            k, n = map(int, given.part.split("/"))
            cases = swept(known)[k - 1 :: n]
        elif not given.kept:
            cases += drawn(known, given.cases, given.seed)
        verdicts, failed = [], []
        # an interrupt ends it with the counts so far
        with contextlib.suppress(KeyboardInterrupt):
            for verdict in tried(known, cases):
                verdicts.append(verdict)
                if verdict.failed:
                    failed.append(verdict)
                    print(verdict.told, file=sys.stderr, flush=True)
    used = [
        sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    ]
    table = table_of(verdicts)
    print(table, "", table_of(verdicts, lambda v: MUTATIONS[v.case.mutation].kind), sep="\n")
    print(f"\n{used[0]:.0f} s of processor time here, {used[1]:.0f} s in {len(verdicts)} cases")
    if given.failed:
        Path(given.failed).write_text("".join(f"{v.case.line}\n" for v in failed), "utf-8")
    if given.json:
        found = {"table": table, "tried": len(verdicts), "failed": [v.told for v in failed]}
        found["refused undamaged"] = refused
        Path(given.json).write_text(json.dumps(found), "utf-8")
    return 1 if failed or refused else 0


if __name__ == "__main__":
    sys.exit(main())
