"""Labels of matches: names of codes, unit, counts and notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Int

LABELS_OF_CODES = {
    "exposure": "exposure_names",
    "chip": "chip_numbers",
    "filter": "filter_names",
}
DEFAULT_LABELS: dict[str, Any] = {"exposure": "1", "chip": 1, "filter": ""}


@dataclass(frozen=True, eq=False)
class Labels:
    """Attributes shared by all batches of matches; the fields are those of `Matches`."""

    unit: str
    exposure_names: tuple[str, ...]
    chip_numbers: tuple[int, ...]
    filter_names: tuple[str, ...]
    sources: tuple[str, ...]
    n_rows: int
    tangent_point: tuple[float, float] | None = None
    chip_names: tuple[str, ...] = ()
    rejected: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    match_radius: float | None = None

    def arguments(self) -> dict[str, Any]:
        """Arguments of `Matches` by name."""
        return {label_field.name: getattr(self, label_field.name) for label_field in fields(self)}

    def of_batch(self, n: int) -> Labels:
        """Labels of a batch of n rows, without the counts of rejected rows."""
        return replace(self, n_rows=n, rejected={})

    def codes(self, key: str, block: Mapping[str, Any], *, source: str) -> Int:
        """Codes of a block's exposures, chips or filters, converted to the labels of all files.

        InputError for a label that did not exist when the files were scanned.
        """
        code_by_label = self._numbers[key]
        labels = block[LABELS_OF_CODES[key]]
        try:
            code_of_label = np.array([code_by_label[label] for label in labels], np.int64)
        except KeyError:
            raise InputError(
                "has changed since it was opened", where=source, do="start again"
            ) from None
        return recoded(key, block, code_of_label)

    @cached_property
    def _numbers(self) -> dict[str, dict[Any, int]]:
        """Code of each label, by the kind of label."""
        return {
            key: {label: k for k, label in enumerate(getattr(self, names))}
            for key, names in LABELS_OF_CODES.items()
        }


def recoded(key: str, block: Mapping[str, Any], code_of_label: Int) -> Int:
    """Codes (N,) of a block, converted with the new code of each of its labels."""
    codes = block.get(key)
    if codes is None:
        codes = np.zeros(len(block["x"]), np.int64)
    return code_of_label[codes]


def merged_counts(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """Sums of counts by key."""
    total: dict[str, int] = {}
    for count_by_key in counts:
        for key, number in count_by_key.items():
            total[key] = total.get(key, 0) + number
    return total
