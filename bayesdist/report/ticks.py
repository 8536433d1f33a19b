"""Numbers at ticks without mathematical text, whose layout takes most of the time of drawing."""

from __future__ import annotations

import re

from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, ScalarFormatter

__all__ = ["plain_ticks"]

_RAISED = str.maketrans("0123456789-−", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁻")


class _Powers(LogFormatterSciNotation):
    """Powers of ten in raised digits."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        text = super().__call__(x, pos)
        text = text.removeprefix(r"$\mathdefault{").removesuffix("}$")
        return re.sub(r"\^\{(.*?)\}", lambda m: m[1].translate(_RAISED), _signs(text))


class _Plain(ScalarFormatter):
    """Decimal numbers, a power of ten that they share in raised digits."""

    def get_offset(self) -> str:
        text = super().get_offset()
        number, e, power = text.partition("e")
        if not e:
            return text
        times = f"{number}×" if number not in ("", "1") else "×"
        return f"{times}10{power.removeprefix('+').translate(_RAISED)}"


def _signs(text: str) -> str:
    return text.replace(r"\times", "×").replace("-", "−")


def plain_ticks(figure: Figure) -> None:
    """Give every axis that has matplotlib's own numbers such without mathematical text."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            for now, put in (
                (axis.get_major_formatter(), axis.set_major_formatter),
                (axis.get_minor_formatter(), axis.set_minor_formatter),
            ):
                if type(now) is ScalarFormatter:
                    put(_Plain(useOffset=now.get_useOffset(), useMathText=False))
                elif type(now) is LogFormatterSciNotation:
                    put(
                        _Powers(
                            now._base,
                            labelOnlyBase=now.labelOnlyBase,
                            minor_thresholds=now.minor_thresholds,
                            linthresh=now._linthresh,
                        )
                    )
