"""What is no plausible file is refused in one sentence, before it takes time or memory."""

from __future__ import annotations

import io
import json
import os
import socket
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from astropy.table import Table

from bayesdist.errors import FormatError, InputError
from bayesdist.files import regular
from bayesdist.files.budget import Budget, FileLimits
from bayesdist.files.documents import DEEPEST, json_of, toml_of
from bayesdist.files.fits import open_fits
from bayesdist.files.hdf5 import hdf5_arrays, netcdf_groups
from bayesdist.files.regular import read_bytes, read_text
from bayesdist.files.tables import read_table
from bayesdist.files.unpacked import read_lines
from bayesdist.utils import memory

# -- no regular file ------------------------------------------------------------------------------


def test_a_pipe_a_device_a_folder_and_nothing(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "folder.csv").mkdir()
    found = socket.socket(socket.AF_UNIX)
    for path, word in [
        (tmp_path / "pipe.csv", "is a pipe, not a file"),
        (Path("/dev/zero"), "is a device, not a file"),
        (tmp_path / "folder.csv", "is a folder, not a file"),
        (tmp_path / "none.csv", "does not exist"),
        (tmp_path / "a\0b.csv", "cannot be read"),
    ]:
        for read in (read_bytes, read_table) if path.suffix else (read_bytes,):
            with pytest.raises(InputError, match=word) as caught:
                read(path)
            assert str(path) in str(caught.value)
    found.close()


def test_a_pipe_is_not_waited_for_by_formats_that_take_paths(tmp_path):
    for name in ("pipe.parquet", "pipe.h5"):
        os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="is a pipe"):
        read_table(tmp_path / "pipe.parquet")
    for read in (hdf5_arrays, netcdf_groups):
        with pytest.raises(InputError, match="is a pipe"):
            read(tmp_path / "pipe.h5")


def test_lines_end_where_files_say(tmp_path):
    (tmp_path / "a").write_bytes(b"a\x0bb\r\nc\x1cd\re\n\xc2\x85f")
    assert read_lines(tmp_path / "a") == ["a\x0bb\r\n", "c\x1cd\r", "e\n", "\x85f"]


def test_text_of_another_encoding(tmp_path):
    (tmp_path / "a").write_bytes(b"name = '\xff'")
    with pytest.raises(FormatError, match="not UTF-8 text at byte 9"):
        read_text(tmp_path / "a")


# -- sizes ----------------------------------------------------------------------------------------


def test_a_sparse_file_is_not_read(tmp_path):
    """It takes no room on the disk, and would take all memory."""
    for name in ("sparse.fits", "sparse.csv"):
        with (tmp_path / name).open("wb") as stream:
            stream.truncate(2**42)
        with pytest.raises(InputError, match=r"has 4.4 TB, of which 0 bytes were ever written"):
            read_table(tmp_path / name)


def test_a_file_that_grows_while_it_is_read(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 100)
    with pytest.raises(InputError, match="has 100 bytes, but at most 99 bytes are read"):
        regular.read_bytes(tmp_path / "a", most=99)


def test_headers_that_announce_more_than_follows():
    image = fits.ImageHDU(np.zeros((3, 4)))
    whole = fits.HDUList([fits.PrimaryHDU(), image])
    stream = io.BytesIO()
    whole.writeto(stream)
    raw = stream.getvalue()
    assert len(open_fits(raw, Budget("a.fits", len(raw)))) == 2
    for old, new in [
        (b"NAXIS1  =                    4", b"NAXIS1  =         400000000000"),
        (b"NAXIS1  =                    4", b"NAXIS1  =                   -4"),
        (b"NAXIS1  =                    4", b"NAXIS1  =                  4.0"),
        (b"PCOUNT  =                    0", b"PCOUNT  =                -2880"),
    ]:
        assert old in raw
        with pytest.raises(FormatError, match="the header of HDU 1 announces"):
            open_fits(raw.replace(old, new), Budget("a.fits", len(raw)))
    with pytest.raises(FormatError, match="HDU 1"):
        open_fits(raw[:5760], Budget("a.fits", 5760))


def test_a_table_of_rows_that_are_not_there(tmp_path):
    path = tmp_path / "a.fits"
    Table({"x": [1.0, 2.0]}).write(path)
    raw = path.read_bytes()
    path.write_bytes(
        raw.replace(b"NAXIS2  =                    2", b"NAXIS2  =          90000000000")
    )
    with pytest.raises(FormatError, match="announces 720000000000 bytes"):
        read_table(path)
    path = tmp_path / "a.vot"
    Table({"x": [1.0, 2.0]}).write(path, format="votable")
    text = path.read_text()
    path.write_text(text.replace("<TABLE", '<TABLE nrows="90000000000"', 1))
    with pytest.raises(FormatError, match="announces 90000000000 rows"):
        read_table(path)


def test_columns_that_are_a_million_times_their_file(tmp_path):
    pq.write_table(pa.table({"x": np.zeros(100_000)}), tmp_path / "a.parquet")
    with pytest.raises(FormatError, match="announces 800 kB in a file of"):
        read_table(tmp_path / "a.parquet", FileLimits(content=10_000))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", (10**12,), np.float64, chunks=(1000,))
    for read in (hdf5_arrays, netcdf_groups):
        with pytest.raises(FormatError, match="announces 8 TB in a file of"):
            read(tmp_path / "a.h5")


def test_arrays_that_lie_in_other_files(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(3)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "x")
    with pytest.raises(FormatError, match="'x' lies in another file"):
        hdf5_arrays(tmp_path / "a.h5")


def test_what_would_not_fit_into_memory_is_refused(monkeypatch):
    monkeypatch.setattr(memory, "memory_limit", lambda: 2_000_000)
    memory.require_memory(2e6, "a grid", do="take fewer")
    with pytest.raises(InputError, match=r"a grid would take 80 GB of memory, but at most 2 MB"):
        memory.require_memory(8e10, "a grid", do="take fewer")
    with pytest.raises(InputError, match=r"1e\+288 TB"):
        memory.require_memory(1e300, "a grid", do="take fewer")


@pytest.mark.parametrize(
    ("n", "text"), [(0, "0 bytes"), (999, "999 bytes"), (1000, "1 kB"), (7.4e10, "74 GB")]
)
def test_sizes_in_words(n, text):
    assert memory.size_text(n) == text


# -- trees ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [DEEPEST + 1, 2000, 100_000])
def test_brackets_within_each_other(depth):
    with pytest.raises(FormatError, match="brackets"):
        json_of("[" * depth + "]" * depth, "a.json")
    with pytest.raises(FormatError, match="brackets"):
        toml_of(f"x = {'[' * depth}{']' * depth}", "a.toml")


@pytest.mark.parametrize("part", ["a", '"a b"', "'a.b'", "a "])
@pytest.mark.parametrize("line", ["{} = 1", "[{}]", "[[{}]]", "x = {{{} = 1}}"])
def test_keys_of_many_parts(part, line):
    assert toml_of(line.format(".".join(3 * [part])), "a.toml")
    with pytest.raises(FormatError, match=f"has a key of more than {DEEPEST} parts"):
        toml_of(line.format(".".join(100_000 * [part])), "a.toml")


def test_many_numbers_on_a_line_are_no_key():
    assert toml_of("x = [" + 200 * "1.5, " + "]", "a.toml") == {"x": 200 * [1.5]}


def test_a_number_of_a_hundred_thousand_digits():
    for read, text in ((json_of, "9" * 100_000), (toml_of, "x = " + "9" * 100_000)):
        with pytest.raises(FormatError, match="a whole number has thousands of digits"):
            read(text, "a")


def test_a_tree_that_is_whole():
    tree = {"a": [1, 2.5, None, {"b": "text"}]}
    assert json_of(json.dumps(tree), "a") == tree
    assert toml_of("[a]\nb = [1, 2]", "a") == {"a": {"b": [1, 2]}}
