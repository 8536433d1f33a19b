"""ASDF files in memory; asdf is imported when a file needs it."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from bayesdist.errors import FormatError, InputError
from bayesdist.files.faults import reason_of


def asdf_tree(raw: bytes, where: str) -> Mapping[str, Any]:
    """Tree of an ASDF file, its arrays in memory.

    FormatError for a file that is truncated or damaged, InputError where asdf is not installed.
    """
    asdf = asdf_with_transforms(where)
    with warnings.catch_warnings():
        # tags of Roman's data models, where these are not installed
        warnings.simplefilter("ignore")
        try:
            with asdf.open(io.BytesIO(raw), lazy_load=False, memmap=False) as file:
                return dict(file.tree)
        except Exception as error:  # asdf, yaml and converters raise errors of all kinds
            raise FormatError(
                f"is an ASDF file that cannot be read: {reason_of(error)}",
                where=where,
                do="fetch the file again",
            ) from error


def asdf_with_transforms(where: str) -> ModuleType:
    """The library, with its transforms; InputError where it is not installed."""
    try:
        import asdf
        import asdf_astropy  # noqa: F401 - without it asdf knows no transforms
    except ImportError as error:
        raise InputError(
            "is an ASDF file, for which the package asdf is not installed",
            where=where,
            do="pip install 'bayesdist[asdf]'",
        ) from error
    return asdf
