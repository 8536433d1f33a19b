"""Damage to the bytes of any file, and things that are no files."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import re
import shutil
from pathlib import Path

from hypothesis import strategies as st

from tests.fuzz.mutation import HARMLESS, KNOWABLE, OPEN, changes, replaces

BINARY = ("fits", "parquet", "hdf5", "gz")
TEXT = ("rows", "toml", "json", "text", "asdf")
TABLES = ("rows", "toml", "text")
SPARSE = 1 << 40
BOMB = 1 << 31


def _anywhere(content: bytes):
    return st.fixed_dictionaries({"at": st.integers(0, max(len(content) - 1, 0))})


@changes("truncation", KNOWABLE, *BINARY, arguments=_anywhere)
def cut(content, at):
    return content[:at]


@changes("truncation", OPEN, "toml", "json", "text", "asdf", "rows", arguments=_anywhere)
def cut_text(content, at):
    return content[:at]


@changes("truncation", KNOWABLE)
def emptied(content):
    return b""


@changes(
    "garbage", KNOWABLE, arguments=lambda c: st.fixed_dictionaries({"n": st.integers(1, 5000)})
)
def zeros(content, n):
    return bytes(n)


@changes(
    "garbage",
    OPEN,
    arguments=lambda c: st.fixed_dictionaries(
        {
            "at": st.lists(st.integers(0, max(len(c) - 1, 0)), min_size=1, max_size=6),
            "value": st.integers(0, 255),
        }
    ),
)
def flipped(content, at, value):
    found = bytearray(content)
    for one in at:
        if one < len(found):
            found[one] = value
    return bytes(found)


@changes("garbage", OPEN, arguments=_anywhere)
def twice_from(content, at):
    """The end stands twice."""
    return content + content[at:]


@changes(
    "encoding",
    OPEN,
    *TEXT,
    arguments=lambda c: st.fixed_dictionaries(
        {
            "at": st.integers(0, max(len(c) - 1, 0)),
            "bytes": st.sampled_from(["\0", "\xff\xfe", "\xe9", "\x1b[2J", "\r", "\x0c", "\x1a"]),
        }
    ),
)
def inserted(content, at, bytes):
    return content[:at] + bytes.encode("latin-1") + content[at:]


@changes("encoding", HARMLESS, *TABLES)
def byte_order_mark(content):
    return b"\xef\xbb\xbf" + content


@changes("encoding", HARMLESS, *TABLES)
def windows_lines(content):
    return content.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")


@changes("encoding", HARMLESS, *TABLES)
def old_mac_lines(content):
    return content.replace(b"\r\n", b"\n").replace(b"\n", b"\r")


@changes("encoding", HARMLESS, *TEXT)
def utf16(content):
    return content.decode("utf-8", "replace").encode("utf-16")


CODECS = {"gzip": gzip.compress, "bzip2": bz2.compress, "xz": lzma.compress}


@changes(
    "bomb", KNOWABLE,
    arguments=lambda c: st.fixed_dictionaries({"codec": st.sampled_from(sorted(CODECS))}),
)  # fmt: skip
def compressed(content, codec="gzip"):
    """Another codec under a name that does not say so."""
    return CODECS[codec](content)


@changes(
    "bomb", KNOWABLE, "text",
    arguments=lambda c: st.just(
        {"address": "file:///dev/zero"} if b"<VOTABLE" in c else {"address": ""}
    ),
)  # fmt: skip
def elsewhere(content, address):
    """Data of a VOTable at an address, which would be read for ever."""
    if not address:
        return content
    stream = f'<DATA><BINARY><STREAM href="{address}"/></BINARY></DATA>'.encode()
    return re.sub(rb"<DATA>.*</DATA>", stream, content, flags=re.DOTALL)


_bombs: dict[int, bytes] = {}


@changes("bomb", KNOWABLE, "gz")
def compressed_bomb(content):
    """Two gigabytes of zeros in two megabytes."""
    if BOMB not in _bombs:
        _bombs[BOMB] = b"".join(gzip.compress(bytes(1 << 24), 9) for _ in range(1)) * (BOMB >> 24)
    return _bombs[BOMB]


@replaces("bomb", KNOWABLE)
def sparse(path: Path):
    """A terabyte, of which nothing is on the disk but the beginning."""
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content)
    os.truncate(path, SPARSE)


@replaces("no file", KNOWABLE)
def missing(path: Path):
    path.unlink()


@replaces("no file", KNOWABLE)
def folder(path: Path):
    path.unlink()
    path.mkdir()


@replaces("no file", KNOWABLE)
def fifo(path: Path):
    """A pipe that nobody writes into."""
    path.unlink()
    os.mkfifo(path)


@replaces(
    "no file",
    KNOWABLE,
    arguments=lambda c: st.fixed_dictionaries(
        {"device": st.sampled_from(["/dev/zero", "/dev/null", "/dev/full", "/dev/tty"])}
    ),
)
def device(path: Path, device: str):
    path.unlink()
    path.symlink_to(device)


@replaces("no file", KNOWABLE)
def link_to_itself(path: Path):
    path.unlink()
    path.symlink_to(path.name)


@replaces("no file", HARMLESS)
def link(path: Path):
    """The same file by way of a link."""
    shutil.move(path, path.with_name(f"there-{path.name}"))
    path.symlink_to(f"there-{path.name}")
