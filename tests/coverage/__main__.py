"""Make the whole suite in pieces, print its numbers, draw its figure."""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bayesdist.files.atomic import atomic_path
from bayesdist.report.figures.style import figure_style

from .campaigns import KINDS
from .figure import ranks_figure, reliability_figure
from .runs import EXPOSURES, JUDGED, all_ranks, coverage, probabilities
from .summary import covered_by_term, evenness, excess, farthest, reliability


def kept(path: Path, make: Callable[[], Any]) -> Any:
    if not path.exists():
        with atomic_path(path) as temporary:
            temporary.write_bytes(pickle.dumps(make()))
    return pickle.loads(path.read_bytes())


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.coverage", description=__doc__)
    parser.add_argument("results", type=Path, help="folder in which finished pieces are kept")
    parser.add_argument("--only", help="make this piece and stop, as 'coverage drift'")
    parser.add_argument("--figure", type=Path, help="file to draw reliability to")
    parser.add_argument("--ranks", type=Path, help="file to draw ranks to")
    a = parser.parse_args()
    a.results.mkdir(exist_ok=True)
    pieces = {f"coverage {k}": lambda k=k: coverage(k, full=True) for k in KINDS}
    pieces |= {f"probability {k}": lambda k=k: probabilities(k) for k in JUDGED}
    pieces["ranks"] = lambda: all_ranks(full=True)
    pieces["ranks exposures"] = lambda: all_ranks(full=True, exposures=EXPOSURES)
    names = [a.only] if a.only else list(pieces)
    found = {n: kept(a.results / f"{n.replace(' ', '_')}.pkl", pieces[n]) for n in names}
    for name, result in found.items():
        what, _, kind = name.partition(" ")
        if what == "coverage":
            for one in covered_by_term(kind, result):
                print(
                    f"{kind:18} {one.term:22} {one.level:.1%}: {one.share:.3f} of {one.n}, worth "
                    f"{one.worth:.0f}; rms pull {one.pull:.3f}{'' if one.within() else ' OUTSIDE'}"
                )
        elif what == "ranks":
            for quantity, one in result.items():
                print(
                    f"{kind} {quantity:22} farthest from even {farthest(one):.2f} of {len(one)}, "
                    f"chi-square p {evenness(one):.4f}"
                )
        else:
            for one in reliability(*result):
                print(
                    f"{kind:18} said {one.said:.3f}: {one.met:.3f} of {one.n}, band "
                    "{:.3f} to {:.3f}{}".format(*one.band(), "" if one.within() else " OUTSIDE")
                )
            print(f"{kind:18} more than is said, in standard deviations: {excess(*result):.2f}")
    if a.ranks:
        ranks_figure(found["ranks"]).savefig(a.ranks, dpi=160)
    if a.figure:
        with figure_style():
            reliability_figure({k: found[f"probability {k}"] for k in JUDGED}).savefig(
                a.figure, dpi=160
            )


main()
