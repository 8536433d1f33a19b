"""Words that differ between the kinds of runs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Terminology:
    """Words of messages and reports that differ between the kinds of runs."""

    rows: str = "stars"  # name of the rows that are fitted
    all_rows: str = "matched stars"  # name of the rows before rejection
    false_rows: str = "false matches"
    rejection: str = "least-squares fit"  # sampling itself rejects nothing
    fit: str = "linear fit"  # the fit before sampling
    fit_title: str = "Least-squares fit"  # of its section
    constraint: str = "a prior"  # on parameters that the data do not constrain
    leverage: str = ""  # clause on why residuals are smaller than errors; may be empty
    # True to print the general sections on the data; False if those of the kind say more
    prints_data: bool = True
    held: str = (  # parameters that the data do not constrain
        "Held, and therefore not shown: a prior alone says what these parameters are, and the data"
        " add nothing to it"
    )
    # clauses and sentences on the exposures that errors of positions hold for; may be empty
    whom: str = ""
    new_exposure: str = ""
    # clause on a common shift and rotation in errors of positions of several exposures
    with_shift: str = ", shift and rotation included"
    gauge_of_maps: str = (  # `first`: the first exposure
        "Shift and rotation of the detector as a whole count as errors here, relative to exposure"
        " {first}."
    )
    relative_map: str = ""  # sentence on the map of relative positions, if it is shown
    residuals: str = ""  # sentence on the binned residuals; may be empty
