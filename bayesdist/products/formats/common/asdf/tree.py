"""Trees of ASDF files, read and written."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.products.formats.common.content import Content
from bayesdist.reading.asdf import asdf_tree, asdf_with_transforms

__all__ = ["is_asdf", "packed", "plain", "tagged", "tree_of"]

_START = b"#ASDF"


def is_asdf(content: Content) -> bool:
    """True where a file begins as an ASDF file."""
    return content.raw[: len(_START)] == _START


def tree_of(content: Content) -> Mapping[str, Any]:
    """Tree of an ASDF file, its arrays in memory; errors as of `asdf_tree`."""
    return asdf_tree(content.raw, content.name)


def packed(
    tree: Mapping[str, Any], name: str, in_text: Iterable[NDArray[np.generic]] = ()
) -> bytes:
    """Bytes of an ASDF file with this tree; InputError where asdf is not installed.

    Arrays `in_text` are written as text: pipelines close the file before they evaluate a transform,
    and arrays in binary blocks are not read until then.
    """
    stream = io.BytesIO()
    file = asdf_with_transforms(name).AsdfFile(dict(tree))
    for array in in_text:
        file.set_array_storage(array, "inline")
    file.write_to(stream)
    return stream.getvalue()


def tagged(node: Mapping[str, Any], tag: str, name: str) -> Any:
    """Node with a tag, which needs no converter of its own; errors as for `packed`."""
    asdf_with_transforms(name)
    from asdf.tagged import TaggedDict

    return TaggedDict(dict(node), tag)


def plain(node: Any) -> Any:
    """Node with arrays of numpy, lists and dictionaries in place of asdf's own."""
    if isinstance(node, Mapping):
        return {str(key): plain(value) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [plain(value) for value in node]
    return np.asarray(node) if hasattr(node, "__array__") else node
