"""ASDF files in memory; the package asdf is imported only when a file needs it."""

from __future__ import annotations

import bz2
import io
import math
import re
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any

from bayesdist.errors import FormatError, InputError
from bayesdist.files.budget import DAMAGED, Budget
from bayesdist.files.documents import refuse_multiplied_yaml
from bayesdist.files.faults import reason_of

_TREE_END = re.compile(rb"\r?\n\.\.\.(\r?\n|$)")  # same pattern as in asdf
_MAGIC = b"\xd3BLK"
_HEADER = struct.Struct(">I4sQQQ16s")  # flags, compression, sizes: allocated, used, data; MD5
_STREAMED = 1


def asdf_tree(raw: bytes, budget: Budget, *, max_order: int) -> Mapping[str, Any]:
    """Tree of an ASDF file with its arrays in memory.

    `max_order`: largest order of polynomials. Raises FormatError if the file is truncated or
    damaged, refers to other files, has polynomials of a higher order, or exceeds its limits;
    InputError if asdf is not installed.
    """
    asdf = asdf_with_transforms(budget.where)
    plain = _uncompressed(raw, budget)
    with warnings.catch_warnings():
        # warnings about tags of the Roman data models, if these are not installed
        warnings.simplefilter("ignore")
        try:
            tagged = asdf.util.load_yaml(io.BytesIO(plain), tagged=True)
            _refuse_larger(tagged, budget, max_order)
            with asdf.open(io.BytesIO(plain), lazy_load=False, memmap=False) as file:
                return dict(file.tree)
        except FormatError:
            raise
        except Exception as error:  # asdf, yaml and converters raise many kinds of exceptions
            raise FormatError(
                f"is an ASDF file that cannot be read: {reason_of(error)}",
                where=budget.where,
                do="fetch the file again",
            ) from error


def asdf_with_transforms(where: str) -> ModuleType:
    """Import asdf and its transforms; raises InputError if it is not installed."""
    try:
        import asdf
        import asdf_astropy  # noqa: F401 - registers the transforms with asdf
    except ImportError as error:
        raise InputError(
            "is an ASDF file, for which the package asdf is not installed",
            where=where,
            do="pip install 'bayesdist[asdf]'",
        ) from error
    return asdf


# -- preparation of the bytes that asdf reads ------------------------------------------------------


def _uncompressed(raw: bytes, budget: Budget) -> bytes:
    """Rewrite a file with uncompressed blocks, and without a block index.

    asdf itself would decompress a block without regard to the size in its header.
    """
    tree_end = _TREE_END.search(raw)
    if tree_end is None:
        raise _damaged("its tree has no end", budget)
    refuse_multiplied_yaml(raw[: tree_end.end()].decode("utf-8", "replace"), budget)
    parts, total = [raw[: tree_end.end()]], 0
    for flags, data in _blocks(raw, raw.find(_MAGIC, tree_end.end()), budget):
        total += len(data)
        budget.refuse_arrays(total)
        sizes = (0,) * 3 if flags & _STREAMED else (len(data),) * 3
        header = _HEADER.pack(flags, bytes(4), *sizes, bytes(16))
        parts += [_MAGIC, struct.pack(">H", len(header)), header, data]
    return b"".join(parts)


def _blocks(raw: bytes, at: int, budget: Budget) -> Iterator[tuple[int, bytes]]:
    """Flags and data of the blocks from byte `at`; no blocks if `at` is negative."""
    number, clock = 0, budget.clock()
    while at >= 0 and raw[at : at + 4] == _MAGIC:
        number += 1
        budget.refuse_nodes(number, "blocks")
        begin = at + 6 + int.from_bytes(raw[at + 4 : at + 6])
        if begin - at - 6 < _HEADER.size or begin > len(raw):
            raise _damaged("the header of a block is not whole", budget)
        flags, kind, room, used, size, _ = _HEADER.unpack_from(raw, at + 6)
        if flags & _STREAMED:
            yield flags, raw[begin:]
            return
        if begin + used > len(raw):
            raise _damaged("a block ends before its data", budget)
        budget.refuse_arrays(size)
        codec = kind.strip(b"\0").decode("latin-1")
        data = _decompressed(raw[begin : begin + used], codec, size, budget)
        if len(data) != size:
            raise _damaged(f"a block announces {size} bytes and holds others", budget)
        yield flags, data
        clock()
        at = begin + room


def _decompressed(raw: bytes, kind: str, size: int, budget: Budget) -> bytes:
    """Decompressed data of a block, at most one byte (or one lz4 part) more than `size` bytes."""
    limit = size + 1  # 0 would be no limit
    try:
        if kind == "zlib":
            return zlib.decompressobj().decompress(raw, limit)
        if kind == "bzp2":
            return bz2.BZ2Decompressor().decompress(raw, limit)
        if kind == "lz4":
            return b"".join(_lz4_pieces(raw, size, budget))
    except (OSError, ValueError, zlib.error, struct.error, RuntimeError) as error:
        raise _damaged(f"a block cannot be decompressed ({reason_of(error)})", budget) from error
    if kind:
        raise FormatError(
            f"has blocks that are compressed by {kind[:8]!r}",
            where=budget.where,
            do="write it with zlib, bzp2, lz4 or none",
        )
    return raw


def _lz4_pieces(raw: bytes, limit: int, budget: Budget) -> Iterator[bytes]:
    """Parts of an lz4 block, up to the first one that exceeds `limit` bytes in total.

    Each is preceded by its length and its decompressed size.
    """
    try:
        import lz4.block
    except ImportError:
        raise FormatError(
            "has blocks that are compressed by lz4, which is not installed",
            where=budget.where,
            do="install the package lz4, or write the file with zlib or without compression",
        ) from None
    at = total = 0
    while at < len(raw) and total <= limit:
        (n,) = struct.unpack_from(">I", raw, at)
        (size,) = struct.unpack_from("<I", raw, at + 4)
        total += size
        budget.refuse_arrays(total)
        yield lz4.block.decompress(raw[at + 4 : at + 4 + n])
        at += 4 + n


def _refuse_larger(tree: Any, budget: Budget, max_order: int) -> None:
    """Refuse arrays that are too large or in other files, and polynomials of too high an order.

    The strides of an array may be 0, so its shape can exceed the size of its block.
    """
    nodes, clock, total = [tree], budget.clock(), 0.0
    while nodes:
        node = nodes.pop()
        clock()
        if isinstance(node, Mapping):
            tag = str(getattr(node, "_tag", ""))
            if "/core/ndarray" in tag or {"source", "shape", "datatype"} <= set(node):
                total += _array_size(node, budget)
            if isinstance(node.get("$ref"), str) and not node["$ref"].startswith("#"):
                raise FormatError(
                    "refers to another file", where=budget.where, do="write it with its arrays"
                )
            if "polynomial" in tag:
                _refuse_order(node.get("coefficients"), budget, max_order)
            nodes += node.values()
        elif isinstance(node, list | tuple):
            nodes += node
    budget.refuse_arrays(total)


def _array_size(node: Mapping[str, Any], budget: Budget) -> float:
    """Size of an array in bytes according to its shape and type."""
    if isinstance(node.get("source"), str):
        raise FormatError(
            "an array lies in another file", where=budget.where, do="write it with its arrays"
        )
    return math.prod(float(n) for n in _shape(node)) * _item_size(node.get("datatype"))


def _item_size(datatype: Any) -> float:
    """Size of an element in bytes: of a number, a text ["ucs4", length], or a list of fields."""
    if isinstance(datatype, Mapping):
        n = math.prod(float(side) for side in _shape(datatype))
        return n * _item_size(datatype.get("datatype"))
    if isinstance(datatype, list) and len(datatype) == 2 and isinstance(datatype[1], int):
        length = float(datatype[1]) if datatype[1] >= 0 else math.inf
        return length * (4 if datatype[0] == "ucs4" else 1)
    if isinstance(datatype, list):
        return sum(map(_item_size, datatype))
    bits = re.search(r"\d+$", str(datatype))
    return int(bits[0]) / 8 if bits is not None and len(bits[0]) <= 3 else 8


def _shape(node: Any) -> list[float]:
    """Shape of an array, in a block or inline in the tree; empty if it has none."""
    if isinstance(node, Mapping):
        shape = node.get("shape")
        if shape is None:
            return _shape(node.get("data"))
        return [n if n >= 0 else math.inf for n in shape if isinstance(n, int)]
    shape = []
    while isinstance(node, list | tuple):
        shape.append(len(node))
        node = node[0] if node else None
    return shape


def _refuse_order(coefficients: Any, budget: Budget, max_order: int) -> None:
    order = max(_shape(coefficients), default=1) - 1
    if order > max_order:
        raise FormatError(
            f"has a polynomial of order {order}",
            where=budget.where,
            do=f"give one of order {max_order} at most",
        )


def _damaged(cause: str, budget: Budget) -> FormatError:
    return FormatError(
        f"is an ASDF file that cannot be read: {cause}", where=budget.where, do=DAMAGED
    )
