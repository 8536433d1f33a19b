"""The report as Markdown: a pure function of the JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from tests.benchmarks.processes import STAGES
from tests.benchmarks.scamp import summarised

__all__ = ["to_markdown"]


def _number(value: Any, digits: int = 3) -> str:
    """Three digits, thousands separated, a dash for what is not known."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if size >= digits - 1:
        return f"{round(value, digits - 1 - size):,.0f}"
    if size < -4:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{digits - 1 - size}f}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = ["| " + " | ".join(cells) + " |" for cells in rows]
    rule = "|" + "|".join(["---"] + ["---:"] * (len(head) - 1)) + "|"
    return ["| " + " | ".join(head) + " |", rule, *body, ""]


def _machine(m: dict[str, Any]) -> list[str]:
    flags = m["flags"] or {}
    ram = None if m["ram_gib"] is None else f"{m['ram_gib']:g} GiB"
    facts = {
        "processor": f"{m['cpu']}, {m['cores']} cores",
        "instruction sets": ", ".join(k for k, v in flags.items() if v) or "–",
        "memory": ram or "–",
        "system": f"{m['os']}, Python {m['python']}",
        "libraries": ", ".join(f"{k} {v}" for k, v in m["libraries"].items() if v),
        "date": m["date"],
        "load before the start": _number(m["load"]),
        "revision": m["revision"] or "–",
    }
    return ["| | |", "|---|---|", *(f"| {k} | {v} |" for k, v in facts.items()), ""]


def _commands(part: dict[str, Any]) -> list[str]:
    out = [
        "## Commands",
        "",
        f"{part['n_stars']:,} simulated stars of WISE, order {part['order']}, two requirements. "
        "Each command is a process of its own, imports included; the first run compiles all that "
        "it needs.",
        "",
    ]
    body = [(r["what"], _number(r["cpu_s"]), _number(r["seconds"])) for r in part["rows"]]
    return out + _table(("command", "CPU s", "s"), body)


def _samplers(part: dict[str, Any]) -> list[str]:
    out = [
        "## Samplers",
        "",
        f"One posterior: order {part['order']}, one chip, {part['n_params']} parameters "
        "(coefficients, log j, logit f, log s_out), 3 % false matches, jitter well measured; "
        "float64, exact. ESS is the smaller of bulk and tail, smallest over the parameters. "
        "*Sampling* is the rate once the sampler is warm; *all* counts the linear fit, the search "
        "for the mode, pilot and warm-up as well (compilation never). For emcee's ensembles the "
        "rate is walkers / (tau x seconds of a step): burn-in is not charged. NUTS and DEMove get "
        "the posterior covariance for nothing. *Ratio* is bayesdist's rate over that row's, "
        "sampling against sampling, and all against all.",
        "",
    ]
    head = ("sampler", "N", "ESS/s sampling", "ESS/s all", "ESS per pass")
    head += ("ratio", "ratio, all", "mean, sd against ours", "remarks")
    rows = []
    for r in part["rows"]:
        agreement = r.get("agreement")
        text = "–"
        if agreement is not None:
            low, high = agreement["sd_ratio"]
            text = f"{agreement['shift']:.3f} sd; {low:.3f} to {high:.3f}"
        rows.append(
            (
                r["sampler"],
                f"{r['n_stars']:,}",
                _number(r["rate"]),
                _number(r.get("rate_total")),
                _number(r["per_pass"]),
                _number(r["ratio"]),
                _number(r["ratio_total"]),
                text,
                "; ".join([r["setting"], *r["flags"]]),
            )
        )
    out += _table(head, rows)
    out += ["bayesdist in detail; the limit is one effective sample per pass at the kernel's own "]
    out[-1] += "speed, measured beside it:"
    out.append("")
    head = ("N", "to ESS 400 [s]", "of that linear fit [s]", "longer run: ESS bulk, tail")
    head += ("seconds", "passes", "ESS/pass, all", "ESS/pass, sampling", "us per pass")
    head += ("fraction of limit", "fraction, all", "acceptance", "efficiency")
    out += _table(
        head,
        [
            (
                f"{r['n_stars']:,}",
                _number(r["to_400_s"]),
                _number(r["fit_s"]),
                f"{r['ess_bulk']:,.0f}, {r['ess_tail']:,.0f}",
                _number(r["seconds"]),
                f"{r['passes']:,}",
                _number(r["per_pass"]),
                _number(r["per_pass_sampling"]),
                _number(1e6 * r["seconds_per_pass"]),
                f"{100 * r['share_of_limit']:.0f} %",
                f"{100 * r['share_of_limit_total']:.0f} %",
                _number(r["acceptance"]),
                _number(r["efficiency"]),
            )
            for r in part["rows"]
            if r["sampler"] == "bayesdist"
        ],
    )
    out += ["emcee's ensembles in detail:", ""]
    head = ("sampler", "N", "walkers", "tau bulk, tail [steps]", "chain / tau", "ms per step")
    head += ("density differs by",)
    out += _table(
        head,
        [
            (
                r["sampler"],
                f"{r['n_stars']:,}",
                str(r["walkers"]),
                f"{r['tau_bulk']:.0f}, {r['tau_tail']:.0f}",
                f"{r['tau_lengths']:.0f}",
                _number(1e3 * r["seconds_per_step"]),
                _number(r.get("density_difference")),
            )
            for r in part["rows"]
            if "walkers" in r
        ],
    )
    out += ["NUTS in detail (a pass is a gradient):", ""]
    head = ("basis", "N", "ESS bulk, tail", "sampling [s]", "warm-up [s]", "compilation [s]")
    head += ("gradients", "ms per gradient", "acceptance")
    out += _table(
        head,
        [
            (
                r["setting"],
                f"{r['n_stars']:,}",
                f"{r['ess_bulk']:,.0f}, {r['ess_tail']:,.0f}",
                _number(r["seconds"]),
                _number(r["warmup_s"]),
                _number(r["compile_s"]),
                f"{r['passes']:,}",
                _number(1e3 * r["seconds"] / r["passes"]),
                _number(r["acceptance"]),
            )
            for r in part["rows"]
            if "basis" in r
        ],
    )
    return out


def _kernel(part: dict[str, Any]) -> list[str]:
    roof, rows = part["roofline"], part["rows"]
    counts = [k for k in (1, 2, 4, 8) if any(f"ns_{k}" in r for r in rows)]
    out = [
        "## Kernel",
        "",
        f"Nanoseconds for one star and evaluation of the log-likelihood, {rows[0]['batch']} "
        "parameter vectors at once. numpy: one parameter vector, design matrix stored, BLAS as it "
        "comes. *With rho*: errors correlated between u and v, relative to 1 thread without them, "
        "at most 1.35. "
        "*Expansion*: value, gradient and Hessian at one parameter vector, 1 thread. "
        "Measured ceilings: "
        f"{roof['fma_per_ns']:.1f} multiply-adds per ns and core in the cache, "
        f"{roof['bytes_per_ns']:.1f} GB/s (triad). The roofline is the largest of: "
        f"multiply-adds of two Horner polynomials and {part['mixture_ops']} operations of the "
        "mixture (its inverse root included), 48 bytes of a star shared by the batch.",
        "",
    ]
    head = ["order", "N"]
    for k in counts:
        head += [f"{k} thread{'s' * (k > 1)}", "roofline", "reached"]
    head += ["with rho / 1 thread", "numpy", "numpy / 1 thread", "expansion"]
    body = []
    for r in rows:
        cells = [str(r["order"]), f"{r['n_stars']:,}"]
        for k in counts:
            mine, floor = r.get(f"ns_{k}"), r.get(f"floor_{k}")
            share = "–" if mine is None else f"{100 * floor / mine:.0f} %"
            cells += [_number(mine), _number(floor), share]
        numpy_ns, one = r.get("ns_numpy"), r.get("ns_1")
        times = None if numpy_ns is None or one is None else numpy_ns / one
        rho = None if one is None or "ns_rho" not in r else r["ns_rho"] / one
        body.append([*cells, *map(_number, (rho, numpy_ns, times, r.get("ns_expansion")))])
    return out + _table(head, body)


def _linear(part: dict[str, Any]) -> list[str]:
    out = [
        "## Linear fit",
        "",
        "Seconds. `fit_linear` makes two passes with rejection, formal covariance, rank and "
        "coverage checks; *unclipped* keeps all rows. lstsq: one unweighted solution without "
        "covariance. *Differ by*: largest difference of coefficients between the unclipped fit "
        "and a weighted lstsq, in formal sigmas. astropy: `fit_wcs_from_points`, sip_degree = "
        "order, on the same pairs; *from lstsq*: rms distance of its positions from those of "
        "lstsq. There is no ratio where that exceeds the error of one star.",
        "",
    ]
    head = ("order", "N", "fit_linear", "unclipped", "build design", "lstsq")
    head += ("lstsq with design / fit_linear", "differ by", "astropy", "from lstsq [pix]")
    head += ("astropy / fit_linear", "remarks")
    body = []
    for r in part["rows"]:
        ours, theirs = r["fit_linear_s"], r["astropy_s"]
        body.append(
            (
                str(r["order"]),
                f"{r['n_stars']:,}",
                _number(ours),
                _number(r["fit_linear_unclipped_s"]),
                _number(r["design_s"]),
                _number(r["lstsq_s"]),
                _number((r["design_s"] + r["lstsq_s"]) / ours),
                _number(r["coefficients_differ"]),
                _number(theirs),
                _number(r.get("astropy_apart")),
                _number(theirs / ours if r["astropy_close"] else None),
                "; ".join(r["flags"]) or "–",
            )
        )
    return out + _table(head, body)


def _scaling(part: dict[str, Any]) -> list[str]:
    out = [
        "## Scaling",
        "",
        f"Order {part['order']}, 3 % false matches, to ESS 400, each in a process of its own; "
        "matches are read from Parquet. Memory is the peak of the process, libraries included.",
        "",
    ]
    head = ("N", "read [s]", "fit [s]", "sample [s]", "fit + sample [s]")
    head += ("us per star", "passes", "ESS", "converged", "peak [MB]", "of that before reading")
    out += _table(
        head,
        [
            (
                f"{r['n_stars']:,}",
                _number(r["read_s"]),
                _number(r["fit_s"]),
                _number(r["sample_s"]),
                _number(r["seconds"]),
                _number(1e6 * r["seconds"] / r["n_stars"]),
                f"{r['passes']:,}",
                f"{r['ess']:,.0f}",
                "yes" if r["converged"] else "no",
                f"{r['peak_mb']:,.0f}",
                f"{r['peak_before_mb']:,.0f}",
            )
            for r in part["rows"]
        ],
    )
    for n in part["stopped"]:
        out += [f"N = {n:,} was stopped after {part['limit_s']:g} s.", ""]
    fitted = part["exponent"]
    if fitted is not None:
        text = (
            f"Exponent of fit + sample from N = {fitted['from']:,} to {fitted['to']:,}: "
            f"{fitted['value']:.3f} ± {fitted['error']:.3f}."
        )
        out += [text, ""]
    if part.get("figure"):
        out += [f"![Wall time and memory against the number of stars]({part['figure']})", ""]
    return out


def _wise(part: dict[str, Any]) -> list[str]:
    out = ["## Simulated WISE pairs", ""]
    out += [f"With the partition pattern; written as Parquet in {part['threads']} threads.", ""]
    head = ("band", "pairs", "pairs/s in memory, one thread", "written [s]", "pairs/s written")
    body = [
        (
            r["band"],
            f"{r['n_pairs']:,}",
            f"{r['chunk_rate']:,.0f}",
            _number(r["write_s"]),
            f"{r['write_rate']:,.0f}",
        )
        for r in part["rows"]
    ]
    return out + _table(head, body)


def _budget(part: dict[str, Any]) -> list[str]:
    nx, ny = part["grid"]
    out = [
        "## Error budget",
        "",
        f"Order 5, {part['chips']} chips with drift, a grid of {nx} x {ny} on each, "
        f"{part['epochs']} epochs, {part['draws']:,} draws; drawing included.",
        "",
    ]
    return out + _table(("what", "s"), [(r["what"], _number(r["seconds"])) for r in part["rows"]])


def _scamp(part: dict[str, Any]) -> list[str]:
    nx, ny = part["size"]
    out = [
        "## Self-calibration and SCAMP",
        "",
        f"{part['exposures']} exposures of {nx:g} x {ny:g} pixels at three roll angles, "
        f"{part['stars']:,} stars, order {part['order']}, {part['distortion']:g} pix of "
        "distortion; both begin without it, from commanded pointings. Pixels, on one axis. "
        "*Error*: rms of relative positions over the detector against the truth, linear maps taken "
        "away; *absolute* with them, on the sky of the reference stars. *Claimed*: of the relative "
        "positions, and the fraction of them within one and two of it. *Scatter*: what SCAMP "
        "prints, rms of its residuals between detections and from reference stars. Seconds by the "
        "clock and of the processors.",
        "",
    ]
    if part["absent"]:
        out += [f"{part['absent']}: bayesdist alone.", ""]
    head = ("solution", "false", "seeds", "error", "largest", "absolute", "claimed")
    head += ("within 1, 2", "scatter", "s", "CPU s")
    body = []
    for r in summarised(part["rows"]):
        within, scatter = r.get("within"), [r.get("internal"), r.get("reference")]
        body.append(
            (
                r["solution"],
                f"{100 * r['false']:g} %",
                str(r["seeds"]),
                *(_number(r.get(name)) for name in ("rms", "largest", "absolute", "claimed")),
                "–" if within is None else f"{within[0]:.3f}, {within[1]:.3f}",
                "–" if scatter[0] is None else ", ".join(map(_number, scatter)),
                _number(r["seconds"]),
                _number(r["cpu_s"]),
            )
        )
    out += _table(head, body)
    return out + ([part["scamp"], ""] if part["scamp"] else [])


def _dithers(part: dict[str, Any]) -> list[str]:
    out = [
        "## Self-calibration by size",
        "",
        f"Two chips of 4096 x 2048 pixels, order {part['order']}, three roll angles, 5 % false "
        "detections, without a catalogue, each in a process of its own. *Solve*: detections "
        "grouped into stars, solved, grouped again until nothing changes; *sample*: to ESS 400, "
        "with the catalogue of the stars. Memory is the peak of the process, libraries and "
        "simulation included.",
        "",
    ]
    head = ("exposures", "stars", "detections", "solve [s]", "sample [s]", "together [s]")
    head += ("us per detection", "passes", "converged", "peak [MB]")
    out += _table(
        head,
        [
            (
                str(r["exposures"]),
                f"{r['stars']:,}",
                f"{r['n_stars']:,}",
                _number(r["solve_s"]),
                _number(r["sample_s"]),
                _number(r["seconds"]),
                _number(1e6 * r["seconds"] / r["n_stars"]),
                f"{r['passes']:,}",
                "yes" if r["converged"] else "no",
                f"{r['peak_mb']:,.0f}",
            )
            for r in part["rows"]
        ],
    )
    for n in part["stopped"]:
        out += [f"{n} exposures were stopped after {part['limit_s']:g} s.", ""]
    fitted = part["exponent"]
    if fitted is not None:
        out += [f"Exponent: {fitted['value']:.3f} ± {fitted['error']:.3f}.", ""]
    return out


def _processes(part: dict[str, Any]) -> list[str]:
    first = part["rows"][0]
    out = [
        "## Self-calibration on several processes",
        "",
        f"{first['n_stars']:,} detections in {first['exposures']} exposures of two chips, order "
        f"{part['order']}, {first['n_params']} parameters, in chunks of {part['piece']:,} "
        "detections on workers of this machine: grouped into stars once, solved once, and sampled "
        "to ESS 400. Seconds by the clock, of the processor in the program that starts the run "
        "(with the scheduler), and of the processor on all workers together; peak memory of both, "
        "libraries included.",
        "",
    ]
    head = ("workers", "group [s]", "solve [s]", "sample [s]", "passes", "peak [MB]")
    out += _table(
        head,
        [
            (
                str(r["workers"]) if r["workers"] else "none",
                *(", ".join(_number(v) for v in r[name].values()) for name in STAGES),
                f"{r['passes']:,}",
                f"{r['peak_mb']:,.0f}, {r['workers_peak_mb']:,.0f}",
            )
            for r in part["rows"]
        ],
    )
    for n in part["stopped"]:
        out += [f"{n} workers were stopped after {part['limit_s']:g} s.", ""]
    return out


_PARTS = {
    "commands": _commands,
    "samplers": _samplers,
    "kernel": _kernel,
    "linear": _linear,
    "scaling": _scaling,
    "wise": _wise,
    "budget": _budget,
    "scamp": _scamp,
    "dithers": _dithers,
    "processes": _processes,
}


def _history(history: Sequence[dict[str, Any]]) -> list[str]:
    names = dict.fromkeys(name for one in history for name in one["ratios"])
    return [
        "## By release",
        "",
        "Ratios, the larger the better; `make bench RELEASE=NAME` adds a column, and the weekly "
        "workflow fails where one is a fifth worse than in the last.",
        "",
        *_table(
            ("ratio", *(f"{one['release']} ({one['revision']})" for one in history)),
            [(name, *(_number(one["ratios"].get(name)) for one in history)) for name in names],
        ),
        "![Ratios by release, relative to the first](figures/benchmark_history.png)",
        "",
    ]


def to_markdown(bench: dict[str, Any], history: Sequence[dict[str, Any]] = ()) -> str:
    """The report.

    Parameters
    ----------
    bench : dict
        What stands in bench.json.
    history : sequence of dict
        Ratios of releases.

    Returns
    -------
    str
    """
    out = ["# Benchmarks", ""]
    out += [
        "Written by `make bench`. Ratios compare what was measured in this one run, on the same "
        "machine and cores."
    ]
    if bench["quick"]:
        out[-1] += " **Quick run on tiny problems: the figures mean nothing.**"
    out += ["", *_machine(bench["machine"])]
    for name, part in bench["parts"].items():
        out += _PARTS[name](part)
        out += [f"({part['wall_s']:.0f} s)", ""]
    if history:
        out += _history(history)
    return "\n".join(out).rstrip() + "\n"
