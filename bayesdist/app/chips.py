"""Agreement of the chips of a configuration with those of its data."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.errors import InputError
from bayesdist.model import Chip

__all__ = ["check_chips"]


def check_chips(chips: Sequence[Chip], numbers: Sequence[int]) -> None:
    """Refuse chips that only one side knows.

    Parameters
    ----------
    chips : sequence of Chip
        Of the ``[[chip]]`` blocks; nothing is checked where there is none.
    numbers : sequence of int
        Chip numbers of the matches; (1,) also where they name no chip.

    Raises
    ------
    InputError
        For a chip of the data that has no block, or a block whose chip has no star.
    """
    if not chips:
        return
    # stars that name no chip are on the only one there is, whatever its number
    if len(chips) == 1 and tuple(numbers) in ((1,), (chips[0].number,)):
        return
    known = {c.number for c in chips}
    unknown = [str(n) for n in numbers if n not in known]
    empty = [f"{c.number} ({c.name})" for c in chips if c.number not in set(numbers)]
    if unknown:
        plural = "chips" if len(unknown) > 1 else "chip"
        raise InputError(
            f"there are stars on {plural} {', '.join(unknown)}, which no [[chip]] block describes",
            where="chip",
            do=f"add a block, or leave these stars out (known: "
            f"{', '.join(str(c.number) for c in chips)})",
        )
    if empty:
        plural = "chips" if len(empty) > 1 else "chip"
        raise InputError(
            f"no star lies on {plural} {', '.join(empty)}",
            where="chip",
            do="drop the block, or map column 'chip' in data.columns",
        )
