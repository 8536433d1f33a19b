"""Until when requirements are met: the probability of each against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from bayesdist.report.caption import Caption
from bayesdist.report.style import CYCLE, INK, PALETTE, WIDTH, figure_style, new_figure

if TYPE_CHECKING:
    from bayesdist.assess.horizon import Horizon
    from bayesdist.report.context import ReportInput

__all__ = ["horizon_caption", "probability_in_time"]


def probability_in_time(horizons: Sequence[Horizon]) -> Figure:
    """Probability of meeting each requirement, with its band, and the date at which it is too low.

    Parameters
    ----------
    horizons : sequence of Horizon

    Returns
    -------
    matplotlib.figure.Figure
    """
    with figure_style():
        fig = new_figure(WIDTH, 0.7 + 1.5 * len(horizons))
        panels = fig.subplots(len(horizons), 1, sharex=True, squeeze=False)[:, 0]
        for ax, one in zip(panels, horizons, strict=True):
            asked = one.requirement.probability
            ax.fill_between(one.epoch, one.low, one.high, color=CYCLE[0], alpha=0.25, lw=0)
            ax.plot(one.epoch, one.probability, color=CYCLE[0])
            ax.axhline(asked, color=INK, lw=0.8, ls="--")
            ax.annotate(
                f"asked: {asked:g}",
                (1.0, asked),
                xycoords=ax.get_yaxis_transform(),
                xytext=(3, 0),
                textcoords="offset points",
                va="center",
                fontsize=7.5,
            )
            if one.date is not None:
                early, late = one.interval
                ax.axvspan(
                    one.epoch[0] if early is None else early,
                    one.epoch[-1] if late is None else late,
                    color=PALETTE["vermilion"],
                    alpha=0.2,
                    lw=0,
                )
                ax.axvline(one.date, color=PALETTE["vermilion"])
            ax.set_ylim(-0.03, 1.03)
            ax.set_xlim(one.epoch[0], one.epoch[-1])
            ax.set_ylabel("P(met)")
            ax.set_title(one.sentence)
        panels[-1].set_xlabel("Epoch (yr)")
    return fig


def horizon_caption(inputs: ReportInput) -> Caption:
    """What to see in the curves."""
    return Caption(
        "How long the requirements are met",
        "Probability of meeting each limit as the drift is extrapolated from the last data; the"
        " band is the 95 % interval of counting draws, red the date (with its interval) at which"
        " the probability falls below what is asked. It holds while the drift goes on as the model"
        " has it: a drift that bends is not in it.",
        " ".join(f"{one.sentence}." for one in inputs.horizons),
    )
