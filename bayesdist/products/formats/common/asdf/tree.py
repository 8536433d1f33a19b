"""Trees of ASDF files: the only module that uses asdf, which is imported when a file needs it."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Mapping
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import FormatError, InputError
from bayesdist.products.formats.common.content import Content

__all__ = ["is_asdf", "packed", "plain", "tagged", "tree_of"]

_START = b"#ASDF"


def is_asdf(content: Content) -> bool:
    """True where a file begins as an ASDF file."""
    return content.raw[: len(_START)] == _START


def tree_of(content: Content) -> Mapping[str, Any]:
    """Tree of an ASDF file, its arrays in memory.

    FormatError for a file that is truncated or damaged, InputError where asdf is not installed.
    """
    asdf = _asdf(content.name)
    with warnings.catch_warnings():
        # tags of Roman's data models, where these are not installed
        warnings.simplefilter("ignore")
        try:
            with asdf.open(io.BytesIO(content.raw), lazy_load=False, memmap=False) as file:
                tree = dict(file.tree)
        except Exception as error:  # asdf, yaml and converters raise errors of all kinds
            raise FormatError(
                f"is an ASDF file that cannot be read: {_first_line(error)}",
                where=content.name,
                do="fetch the file again",
            ) from error
    return tree


def packed(
    tree: Mapping[str, Any], name: str, in_text: Iterable[NDArray[np.generic]] = ()
) -> bytes:
    """Bytes of an ASDF file with this tree; InputError where asdf is not installed.

    Arrays `in_text` are written as text: pipelines close the file before they evaluate a transform,
    and arrays in binary blocks are not read until then.
    """
    stream = io.BytesIO()
    file = _asdf(name).AsdfFile(dict(tree))
    for array in in_text:
        file.set_array_storage(array, "inline")
    file.write_to(stream)
    return stream.getvalue()


def tagged(node: Mapping[str, Any], tag: str, name: str) -> Any:
    """Node with a tag, which needs no converter of its own; errors as for `packed`."""
    _asdf(name)
    from asdf.tagged import TaggedDict

    return TaggedDict(dict(node), tag)


def plain(node: Any) -> Any:
    """Node with arrays of numpy, lists and dictionaries in place of asdf's own."""
    if isinstance(node, Mapping):
        return {str(key): plain(value) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [plain(value) for value in node]
    return np.asarray(node) if hasattr(node, "__array__") else node


def _asdf(where: str) -> ModuleType:
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


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
