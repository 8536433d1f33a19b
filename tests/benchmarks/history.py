"""Ratios of the benchmarks by release: kept in a file, drawn over time, compared with a new run.

Only what was measured beside something else in one run is kept, as seconds alone say more of the
machine than of the program.  All ratios are the better the larger they are.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bayesdist.files.atomic import atomic_path
from bayesdist.report.figures.style import PALETTE, WIDTH, figure_style, new_figure
from tests.benchmarks.scamp import summarised

__all__ = ["HISTORY", "ratios_of", "read_history", "regressions", "with_run", "write_history"]

HISTORY = "benchmark_history.json"  # beside the page
WORSE = 0.2  # fraction of a ratio that may be lost: repeated runs differ by half of it
KERNEL_STARS = 50_000  # fewer do not fill two threads, more are a matter of memory


def ratios_of(bench: dict[str, Any]) -> dict[str, float]:
    """Ratios of a benchmark, by what they compare."""
    parts, found = bench["parts"], dict[str, float]()
    for r in parts.get("samplers", {}).get("rows", ()):
        stars = f"{r['n_stars']:,} stars"
        if r["sampler"] == "bayesdist":
            found[f"rate, fraction of its limit, {stars}"] = r["share_of_limit"]
        else:
            found[f"rate, bayesdist / {r['sampler']}, {stars}"] = r["ratio_total"]
    for r in parts.get("kernel", {}).get("rows", ()):
        if r["n_stars"] == KERNEL_STARS and r.get("ns_1"):
            found[f"kernel, fraction of its roofline, order {r['order']}"] = (
                r["floor_1"] / r["ns_1"]
            )
            if "ns_rho" in r:
                found[f"kernel, without / with correlations, order {r['order']}"] = (
                    r["ns_1"] / r["ns_rho"]
                )
    for r in parts.get("linear", {}).get("rows", ()):
        if r["astropy_close"]:
            name = f"seconds, astropy / fit_linear, order {r['order']}, {r['n_stars']:,} stars"
            found[name] = r["astropy_s"] / r["fit_linear_s"]
    scamp = {
        (r["solution"], r["false"]): r for r in summarised(parts.get("scamp", {"rows": ()})["rows"])
    }
    for (solution, false), r in scamp.items():
        ours = scamp.get(("bayesdist, rigid exposures", false))
        if solution == "SCAMP, one instrument" and ours is not None:
            with_false = f"{100 * false:g} % false"
            found[f"processor seconds, SCAMP / bayesdist, {with_false}"] = (
                r["cpu_s"] / ours["cpu_s"]
            )
            found[f"error, SCAMP / bayesdist, {with_false}"] = r["rms"] / ours["rms"]
    return found


def read_history(path: Path) -> list[dict[str, Any]]:
    """Entries of the file, the latest last."""
    found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))
    return found


def with_run(
    history: list[dict[str, Any]], bench: dict[str, Any], release: str
) -> list[dict[str, Any]]:
    """History with a run as the entry of a release, in place of an earlier run of the same."""
    machine = bench["machine"]
    entry = {
        "release": release,
        "revision": machine["revision"],
        "date": machine["date"],
        "processor": machine["cpu"],
        "ratios": {name: float(f"{value:.3g}") for name, value in ratios_of(bench).items()},
    }
    return [*(one for one in history if one["release"] != release), entry]


def regressions(history: list[dict[str, Any]], bench: dict[str, Any]) -> list[str]:
    """Sentences on the ratios that are worse than at the latest release, or are gone."""
    latest, now, out = history[-1], ratios_of(bench), list[str]()
    for name, before in latest["ratios"].items():
        found = now.get(name)
        if found is None:
            out.append(f"{name}: was {before:.3g} at {latest['release']}, and was not measured")
        elif found < (1 - WORSE) * before:
            lost = 100 * (1 - found / before)
            out.append(
                f"{name}: {found:.3g}, {lost:.0f} % less than {before:.3g} at {latest['release']}"
            )
    return out


def write_history(history: list[dict[str, Any]], folder: Path) -> None:
    """Write the file and its figure."""
    with atomic_path(folder / HISTORY) as path:
        path.write_text(json.dumps(history, indent=1) + "\n", encoding="utf-8")
    draw_history(history, folder / "figures" / "benchmark_history.png")


def draw_history(history: list[dict[str, Any]], path: Path) -> None:
    """Each ratio by release, relative to the first release that has it, one panel for each kind."""
    names = list(dict.fromkeys(name for one in history for name in one["ratios"]))
    kinds = list(dict.fromkeys(name.split(",")[0] for name in names))
    releases = [one["release"] for one in history]
    colors = list(PALETTE.values())
    with figure_style():
        fig = new_figure(WIDTH, 1.9 * len(kinds))
        panels = fig.subplots(len(kinds), 1, sharex=True, squeeze=False)[:, 0]
        for kind, ax in zip(kinds, panels, strict=True):
            for k, name in enumerate(n for n in names if n.split(",")[0] == kind):
                known = [
                    (i, one["ratios"][name])
                    for i, one in enumerate(history)
                    if name in one["ratios"]
                ]
                places, values = zip(*known, strict=True)
                label = name.removeprefix(f"{kind}, ")
                color = colors[k % len(colors)]
                ax.plot(
                    places, [v / values[0] for v in values], "o-", ms=3, color=color, label=label
                )
            ax.axhline(1.0, lw=0.6, color=PALETTE["black"])
            ax.set_title(kind)
            ax.set_ylabel("ratio / first")
            ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=6)
        panels[-1].set_xticks(range(len(releases)), releases)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            fig.savefig(temporary, dpi=130)
