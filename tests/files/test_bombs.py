"""Small files that hold, or announce, more than any file may: of each container and codec."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import re
import tracemalloc
import zlib
from contextlib import nullcontext
from inspect import signature
from pathlib import Path

import h5netcdf
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from astropy.table import Table

from bayesdist.data.tables.parquet import describe_part
from bayesdist.errors import FormatError, InputError
from bayesdist.files.asdf import asdf_tree
from bayesdist.files.budget import Budget, FileLimits
from bayesdist.files.documents import refuse_multiplied_yaml
from bayesdist.files.fits import open_fits
from bayesdist.files.hdf5 import hdf5_arrays, netcdf_groups
from bayesdist.files.regular import PIECE
from bayesdist.files.tables import TABLE_SUFFIXES, read_table
from bayesdist.files.unpacked import CODECS, TextCounts, read_unpacked, unpacked
from bayesdist.products.common.content import Content

N = 2000
SMALL = FileLimits(content=10_000, content_per_byte=2, arrays=10_000)
COMPRESS = {"gzip": gzip.compress, "bzip2": bz2.compress, "xz": lzma.compress}
WRITTEN_AS = {
    ".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".tsv": "ascii.tab", ".fits": "fits",
    ".fit": "fits", ".ldac": "fits", ".vot": "votable", ".xml": "votable", ".tbl": "ascii.ipac",
    ".ipac": "ascii.ipac",
}  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, bytes]:
    """A table of equal rows, in each container."""
    folder = tmp_path_factory.mktemp("bombs")
    table = Table({name: np.full(N, 1.5) for name in ("x", "y", "u", "v")})
    out = {}
    for suffix, form in WRITTEN_AS.items():
        path = folder / f"a{suffix}"
        table.write(path, format=form)
        out[suffix] = path.read_bytes()
    return out


def test_every_container_and_codec_has_a_bomb():
    assert set(WRITTEN_AS) | {".parquet"} == set(TABLE_SUFFIXES)
    assert set(COMPRESS) == {name for _, name, _ in CODECS}


@pytest.mark.parametrize("codec", COMPRESS)
@pytest.mark.parametrize("suffix", WRITTEN_AS)
def test_tables_that_are_compressed(written, suffix, codec, tmp_path):
    for name in (f"a{suffix}", f"b{suffix}.gz"):
        path = tmp_path / name
        path.write_bytes(COMPRESS[codec](written[suffix]))
        assert np.array_equal(read_table(path)["x"], np.full(N, 1.5))
        with pytest.raises(FormatError, match=f"compressed by {codec} .* holds more than 10 kB"):
            read_table(path, SMALL)


@pytest.mark.parametrize("codec", COMPRESS)
def test_content_of_any_kind(codec, tmp_path):
    path = tmp_path / "a"
    path.write_bytes(COMPRESS[codec](bytes(100_000)))
    assert read_unpacked(path)[0] == bytes(100_000)
    with pytest.raises(FormatError, match="holds more than 10 kB"):
        read_unpacked(path, SMALL)


@pytest.mark.parametrize("codec", COMPRESS)
def test_content_that_is_refused_is_not_held(codec):
    raw, size = 8 * COMPRESS[codec](bytes(PIECE)), 8 * PIECE
    for most, fits_in in ((size - 1, False), (size, True)):
        limits = FileLimits(content=most, content_per_byte=0, held=PIECE // 2)
        tracemalloc.start()
        try:
            if fits_in:
                assert unpacked(raw, Budget("a", len(raw), limits)) == bytes(size)
            else:
                with pytest.raises(FormatError, match=r"holds more than 134 MB"):
                    unpacked(raw, Budget("a", len(raw), limits))
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert (peak < 6 * PIECE) != fits_in


@pytest.mark.parametrize("codec", COMPRESS)
def test_content_in_several_streams(codec):
    first, second = COMPRESS[codec](b"x,y\n"), COMPRESS[codec](b"1,2\n")
    padding = b"" if codec == "bzip2" else bytes(4)
    assert unpacked(first + second + padding, Budget("a", 100)) == b"x,y\n1,2\n"


def test_xz_with_a_large_dictionary():
    filters = [{"id": lzma.FILTER_LZMA2, "dict_size": 2**30}]
    stream = io.BytesIO()
    with lzma.open(stream, "wb", filters=filters) as file:
        file.write(b"x,y\n1,2\n")
    with pytest.raises(FormatError, match=r"is a broken xz file \(Memory usage limit"):
        unpacked(stream.getvalue(), Budget("a", 100))


@pytest.mark.parametrize("end", ["\n", "\r", "\r\n"])
def test_rows_and_cells_are_counted_over_all_pieces(end):
    text = end.join(f"{k} {k}, {k}\t{k}" for k in range(10)).encode() + end.encode()
    for step in (1, 2, 3, 1000):
        for limits, words in [
            (FileLimits(rows=10, rows_per_byte=0, cells=40, cells_per_byte=0), None),
            (FileLimits(rows=9, rows_per_byte=0), "holds 10 rows"),
            (FileLimits(cells=39, cells_per_byte=0), "holds 40 cells"),
        ]:
            counts = TextCounts(Budget("a", 100, limits), compressed=True)
            with nullcontext() if words is None else pytest.raises(FormatError, match=words):
                for at in range(0, len(text), step):
                    counts.add(text[at : at + step])


@pytest.mark.parametrize("codec", COMPRESS)
def test_compressed_twice_in_other_ways_or_in_part(codec):
    one = COMPRESS[codec](b"x,y\n1,2\n")
    for outer in COMPRESS.values():
        with pytest.raises(FormatError, match="is compressed twice"):
            unpacked(outer(one), Budget("a", 100))
    with pytest.raises(FormatError, match=f"is a broken {codec} file"):
        unpacked(one[:-3], Budget("a", 100))
    for start, name in ((b"PK\3\4", "zip"), (b"\x1f\x9d", "compress"), (b"(\xb5/\xfd", "zstd")):
        with pytest.raises(FormatError, match=f"is compressed by {name}; decompress it first"):
            unpacked(start + bytes(10), Budget("a", 100))


@pytest.mark.parametrize("codec", ["none", "snappy", "gzip", "zstd", "brotli", "lz4"])
def test_parquet_of_equal_numbers(codec, tmp_path):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"x": np.full(N, 1.5)}), path, compression=codec)
    assert np.array_equal(read_table(path)["x"], np.full(N, 1.5))
    with pytest.raises(FormatError, match="announces 16 kB in a file of"):
        read_table(path, SMALL)


@pytest.mark.parametrize("codec", [None, "gzip", "lzf"])
def test_hdf5_of_equal_numbers(codec, tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=np.full(N, 1.5), compression=codec, chunks=(100,))
    assert np.array_equal(hdf5_arrays(path)[0]["x"], np.full(N, 1.5))
    if codec is not None:
        for read in (hdf5_arrays, netcdf_groups):
            with pytest.raises(FormatError, match="announces 16 kB in a file of"):
                read(path, limits=FileLimits(content=10_000, content_per_byte=0))


@pytest.mark.parametrize("codec", ["zlib", "bzp2", "lz4"])
def test_blocks_of_asdf(codec):
    asdf = pytest.importorskip("asdf")
    stream, values = io.BytesIO(), np.full(N, 1.5)
    asdf.AsdfFile({"a": values, "b": values + 1}).write_to(stream, all_array_compression=codec)
    raw = stream.getvalue()
    tree = asdf_tree(raw, Budget("a.asdf", len(raw)), max_order=12)
    assert np.array_equal(tree["a"], values)
    assert np.array_equal(tree["b"], values + 1)
    with pytest.raises(FormatError, match="announces 16 kB in a file of"):
        asdf_tree(raw, Budget("a.asdf", len(raw), SMALL), max_order=12)
    # a block that holds more than it announces
    announced = (8 * N).to_bytes(8)
    assert raw.count(announced) == 2
    less = raw.replace(announced, (80).to_bytes(8))
    for limits in (FileLimits(), SMALL):
        with pytest.raises(FormatError, match=r"and holds others|announces \d"):
            asdf_tree(less, Budget("a.asdf", len(raw), limits), max_order=12)


def test_asdf_of_many_blocks_and_of_constant_planes():
    asdf = pytest.importorskip("asdf")
    for tree in (
        {f"a{k}": np.full(20, float(k)) for k in range(1200)},
        {"u": np.zeros((2048, 2048)), "v": np.ones((2048, 2048))},
    ):
        stream = io.BytesIO()
        asdf.AsdfFile(tree).write_to(stream, all_array_compression="zlib")
        raw = stream.getvalue()
        out = asdf_tree(raw, Budget("a.asdf", len(raw)), max_order=12)
        assert all(np.array_equal(out[name], values) for name, values in tree.items())


def test_chunks_of_hdf5_that_hold_more_than_a_chunk(tmp_path):
    """HDF5 decompresses a chunk to its end, whatever the size of its array."""
    path = tmp_path / "a.h5"
    for content, words in ((bytes(80), None), (bytes(10**8), "has a chunk of 80 bytes that holds")):
        with h5py.File(path, "w") as file:
            array = file.create_dataset("x", (10,), float, chunks=(10,), compression="gzip")
            try:
                array.id.write_direct_chunk((0,), zlib.compress(content, 1))
            except OSError:
                pytest.skip("this HDF5 writes no chunk that is larger than it should be")
        if words is None:
            assert not hdf5_arrays(path)[0]["x"].any()
            continue
        for read in (hdf5_arrays, netcdf_groups):
            with pytest.raises(FormatError, match=words):
                read(path)


def test_arrays_of_hdf5_that_are_compressed_twice(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((10,))
        layout.set_deflate(1)
        layout.set_deflate(1)
        space = h5py.h5s.create_simple((10,))
        h5py.h5d.create(file.id, b"x", h5py.h5t.NATIVE_DOUBLE, space, layout)
    with pytest.raises(FormatError, match="has an array with an unsupported compression"):
        hdf5_arrays(tmp_path / "a.h5")


# -- text -----------------------------------------------------------------------------------------


def test_long_lines_many_lines_many_cells_and_many_columns(tmp_path):
    path, zipped = tmp_path / "a.csv", tmp_path / "b.csv.gz"
    path.write_text("# " + 100 * "a" + "\nx,y\n" + 200 * "1,2\n")
    assert len(read_table(path)) == 200
    for limits, words in [
        (FileLimits(line=50), "line 1: has 103 characters, but at most 50 are read"),
        (FileLimits(rows=100, rows_per_byte=0), "holds 202 rows in a file of"),
        (FileLimits(columns=1), "has more than 1 columns"),
    ]:
        with pytest.raises(FormatError, match=words):
            read_table(path, limits)
    zipped.write_bytes(gzip.compress(path.read_bytes()))
    with pytest.raises(FormatError, match="holds 404 cells"):
        read_table(zipped, FileLimits(cells=100, cells_per_byte=0))
    with pytest.raises(FormatError, match="takes more than"):
        read_table(zipped, FileLimits(seconds=0, seconds_per_byte=0))


def test_long_comments_take_no_time(tmp_path):
    """astropy's reader takes the square of their length."""
    path = tmp_path / "a.csv"
    path.write_text(20 * ("# " + 60_000 * "a" + "\n") + "x,y\n1,2\n")
    assert len(read_table(path, FileLimits(seconds=1))) == 1


# -- trees ----------------------------------------------------------------------------------------

LAUGHS = "\n".join(
    ["a0: &a0 [x, x, x, x, x]", *(f"a{k}: &a{k} [{','.join(5 * [f'*a{k - 1}'])}]" for k in (1, 2))]
)


@pytest.mark.parametrize(
    ("text", "limits", "words"),
    [
        (LAUGHS, FileLimits(nodes=100), "has more than 100 nodes in its YAML, with aliases"),
        ("a: &a [1, *a]", FileLimits(), "YAML that refers to itself"),
        ("[" * 20 + "]" * 20, FileLimits(depth=10), "more than 10 brackets within each other"),
        ("a: " + 200 * "x", FileLimits(header=100), "more than 100 characters in its header"),
        ("a: [1", FileLimits(), "is not YAML that can be read"),
        (LAUGHS, FileLimits(seconds=0, seconds_per_byte=0), "takes more than"),
    ],
)
def test_trees_of_yaml(text, limits, words):
    with pytest.raises(FormatError, match=words):
        refuse_multiplied_yaml(text, Budget("a", len(text), limits))


def test_aliases_of_a_plausible_size_pass():
    refuse_multiplied_yaml("%ECSV 1.0\n---\n" + LAUGHS, Budget("a", 100))


def test_aliases_in_every_header(tmp_path):
    table, limits = Table({"x": [1.0, 2.0], "y": [3.0, 4.0]}), FileLimits(nodes=100)
    ecsv, other, parquet = (tmp_path / n for n in ("a.ecsv", "b.tbl", "a.parquet"))
    table.write(ecsv)
    lines = ecsv.read_text().splitlines()
    meta = ["# meta:", *(f"#   {line}" for line in LAUGHS.splitlines())]
    at = next(k for k, line in enumerate(lines) if line.startswith("# schema"))
    for path in (ecsv, other):
        path.write_text("\n".join([*lines[:at], *meta, *lines[at:]]) + "\n")
    text = "\n".join(line[2:] for line in [*lines[2:at], *meta])
    rows = pa.table({name: np.asarray(table[name]) for name in table.colnames})
    pq.write_table(rows.replace_schema_metadata({"table_meta_yaml": text}), parquet)
    for path in (ecsv, other, parquet):
        assert len(read_table(path)) == 2
        with pytest.raises(FormatError, match="with aliases"):
            read_table(path, limits)


def test_aliases_in_asdf():
    pytest.importorskip("asdf")
    raw = b"#ASDF 1.0.0\n%YAML 1.1\n--- !<tag:stsci.edu:asdf/core/asdf-1.1.0>\n"
    raw += LAUGHS.encode() + b"\n...\n"
    assert set(asdf_tree(raw, Budget("a", len(raw)), max_order=12)) >= {"a0", "a1", "a2"}
    with pytest.raises(FormatError, match="with aliases"):
        asdf_tree(raw, Budget("a", len(raw), FileLimits(nodes=100)), max_order=12)


ARRAY = "!<tag:stsci.edu:asdf/core/ndarray-1.1.0> {{source: {}, shape: {}, datatype: float64{}}}"


@pytest.mark.parametrize(
    ("node", "words"),
    [
        (ARRAY.format(0, "[100000, 100000]", ", strides: [0, 0]"), "announces 80 GB"),
        (ARRAY.format("file:///etc/passwd", "[10]", ""), "an array lies in another file"),
        ("{$ref: 'http://127.0.0.1:9/a.asdf#/b'}", "refers to another file"),
        (
            "!<tag:stsci.edu:asdf/transform/polynomial-1.2.0> {coefficients: "
            + ARRAY.format(0, "[14, 14]", "")
            + "}",
            "has a polynomial of order 13",
        ),
    ],
)
def test_what_asdf_would_fetch_or_make(node, words):
    pytest.importorskip("asdf")
    raw = b"#ASDF 1.0.0\n%YAML 1.1\n--- !<tag:stsci.edu:asdf/core/asdf-1.1.0>\na: "
    raw += node.encode() + b"\n...\n"
    with pytest.raises(FormatError, match=words):
        asdf_tree(raw, Budget("a", len(raw)), max_order=12)


def test_groups_that_are_linked_twice(tmp_path):
    """There are 2^30 paths to one array."""
    for depth, words in ((30, "announces"), (70, "has more than 64 groups within each other")):
        path = tmp_path / f"{depth}.h5"
        with h5py.File(path, "w") as file:
            group = file.create_group("a")
            for _ in range(depth):
                inner = group.create_group("a")
                group["b"] = inner
                group = inner
            group["x"] = np.zeros(10)
        for read in (hdf5_arrays, netcdf_groups):
            with pytest.raises(FormatError, match=words):
                read(path)


@pytest.mark.parametrize("what", ["texts", "arrays", "attribute"])
def test_values_of_hdf5_that_share_one_place(what, tmp_path):
    """Each states its length and where it lies: here all lie where the first one does."""
    path, n, length = tmp_path / "a.h5", 1000, 99_999
    kind = h5py.vlen_dtype(np.uint8) if what == "arrays" else h5py.string_dtype()
    with h5py.File(path, "w") as file:
        if what == "attribute":
            file.attrs.create("x", [length * "a", *(n - 1) * ["a"]], dtype=kind)
        else:
            file.create_dataset("x", (n,), kind)[0] = (
                length * "a" if what == "texts" else np.ones(length, np.uint8)
            )
    raw = path.read_bytes()
    assert len(raw) < 400_000
    stated = length.to_bytes(4, "little")  # then 8 bytes for the place of a heap, and 4 in it
    at = raw.index(stated)
    while not 0 < int.from_bytes(raw[at + 4 : at + 12], "little") < len(raw):
        at = raw.index(stated, at + 1)
    path.write_bytes(raw[:at] + n * raw[at : at + 16] + raw[at + 16 * n :])
    for read in (hdf5_arrays, netcdf_groups):
        with pytest.raises(FormatError, match=r"announces .* MB in a file of"):
            read(path)


def test_groups_that_hold_themselves_and_many_links(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("a")
        group["b"] = group
        group["x"] = np.arange(3)
    assert list(netcdf_groups(tmp_path / "a.h5")["a"].arrays["x"]) == [0, 1, 2]
    with pytest.raises(FormatError, match="has more than 2 groups and arrays"):
        netcdf_groups(tmp_path / "a.h5", FileLimits(nodes=2))
    with pytest.raises(FormatError, match="takes more than"):
        netcdf_groups(tmp_path / "a.h5", FileLimits(seconds=0, seconds_per_byte=0))
    with h5py.File(tmp_path / "b.h5", "w") as file:  # one chunk, which is read whole
        file.create_dataset("x", (1,), "f4", chunks=(2**26,), maxshape=(None,))
    with pytest.raises(FormatError, match="announces 268 MB"):
        hdf5_arrays(tmp_path / "b.h5")


# -- tables ---------------------------------------------------------------------------------------


def test_one_long_text_in_all_rows(tmp_path):
    path, n = tmp_path / "a.parquet", 1000
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(n, np.int32)), pa.array([9000 * "x"]))
    pq.write_table(pa.table({"x": np.arange(n), "name": texts}), path)
    with pytest.raises(FormatError, match="announces 36 MB in a file of"):
        read_table(path)
    assert len(read_table(path, FileLimits(content=2**27))) == n


@pytest.mark.parametrize("kind", ["record", "list", "fixed"])
def test_long_text_within_cells_and_of_one_width(kind, tmp_path):
    path, n = tmp_path / "a.parquet", 5000
    values = {
        "record": [{"a": 9000 * "x"}] * n,
        "list": [[9000 * "x"]] * n,
        "fixed": [bytes(9000)] * n,
    }
    types = {
        "record": pa.struct([("a", pa.string())]),
        "list": pa.list_(pa.string()),
        "fixed": pa.binary(9000),
    }
    pq.write_table(pa.table({"x": np.arange(n), "name": pa.array(values[kind], types[kind])}), path)
    assert path.stat().st_size < 300_000
    with pytest.raises(FormatError, match="announces"):
        read_table(path)
    read = pytest.raises(InputError, match="announces" if kind == "fixed" else "several strings")
    with read:
        list(describe_part(path).blocks(["x", "name"], size=100))
    if kind != "fixed":
        assert sum(map(len, describe_part(path).blocks(["x"], size=100))) == n


def test_pages_of_parquet_that_hold_more_than_their_column_announces(tmp_path):
    """The footer announces 300 numbers in 3 kB, and the one page holds more."""
    if "max_rows_per_page" not in signature(pq.ParquetWriter).parameters:
        pytest.skip("this pyarrow writes no page of so many rows")
    path, n = tmp_path / "a.parquet", 6_000_000
    pq.write_table(pa.table({"x": np.zeros(n)}), path, compression="zstd", use_dictionary=False,
                   data_page_size=2**30, max_rows_per_page=n, write_batch_size=n, row_group_size=n,
                   write_statistics=False, store_schema=False)  # fmt: skip
    column = pq.read_metadata(path).row_group(0).column(0)
    raw = path.read_bytes()
    footer = raw[-8 - int.from_bytes(raw[-8:-4], "little") :]
    changed = footer
    for old, new in ((n, 300), (column.total_uncompressed_size, 3000)):
        assert _varint(2 * old, 4) in changed
        changed = changed.replace(_varint(2 * old, 4), _varint(2 * new, 4))
    path.write_bytes(raw[: -len(footer)] + changed)
    assert pq.read_metadata(path).num_rows == 300
    with pytest.raises(FormatError, match="announces 48 MB in a file of"):
        read_table(path)


def _varint(value: int, n: int) -> bytes:
    """Integer of Thrift in n bytes, of which the last may be 0."""
    return bytes(value >> 7 * k & 127 | 128 * (k < n - 1) for k in range(n))


@pytest.mark.parametrize("text", [1, 3000, 50_000])  # bytes of the statistics of each page
@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_headers_of_pages(text, version, tmp_path):
    """Their pages together hold what the footer, which is right, announces."""
    path = tmp_path / "a.parquet"
    names = [f"{k % 7}" + text * "x" for k in range(1000)]
    pq.write_table(pa.table({"x": np.arange(1000.0), "name": names}), path, data_page_size=2000,
                   data_page_version=version, use_dictionary=["x"], compression="snappy",
                   write_page_checksum=True, row_group_size=300)  # fmt: skip
    metadata = pq.read_metadata(path)
    groups = map(metadata.row_group, range(metadata.num_row_groups))
    stated = sum(g.column(k).total_uncompressed_size for g in groups for k in range(2))
    largest = FileLimits(content=2**28)
    assert len(read_table(path, largest)) == 1000
    with pytest.raises(FormatError, match="announces"):
        read_table(path, FileLimits(content=stated - 1, content_per_byte=0))


def test_rows_columns_and_lists_of_parquet(tmp_path):
    path = tmp_path / "a.parquet"
    lists = pa.array([[0] * 1000] * 10)
    pq.write_table(pa.table({"x": np.zeros(10), "y": lists}), path)
    for limits, words in [
        (FileLimits(rows=5, rows_per_byte=0), "announces 10 rows"),
        (FileLimits(columns=1), "has more than 1 columns"),
        (FileLimits(cells=5000, cells_per_byte=0), r"holds 1e\+04 cells"),
        (FileLimits(seconds=0, seconds_per_byte=0), "takes more than"),
    ]:
        with pytest.raises(FormatError, match=words):
            read_table(path, limits)


def _fits(*hdus) -> bytes:
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(stream)
    return stream.getvalue()


def test_parts_and_cards_of_fits():
    many = _fits(*(fits.ImageHDU() for _ in range(5)))
    cards = fits.ImageHDU(header=fits.Header([(f"A{k}", k) for k in range(50)]))
    for raw, limits, words in [
        (many, FileLimits(parts=3), "has more than 3 HDUs"),
        (_fits(cards), FileLimits(nodes=40), "has more than 40 header cards"),
        (many, FileLimits(seconds=0, seconds_per_byte=0), "takes more than"),
    ]:
        budget = Budget("a.fits", len(raw))
        assert len(open_fits(raw, budget)) > 1
        with pytest.raises(FormatError, match=words):
            open_fits(raw, Budget("a.fits", len(raw), limits))


def test_images_may_be_constant_and_tables_may_not(tmp_path):
    """A plane of 67 MB is compressed to less than a thousandth."""
    path = tmp_path / "a.fits.gz"
    rows = np.zeros(2**16, [("x", "f8", 128)])
    for hdu, words in (
        (fits.ImageHDU(np.zeros((4096, 4096), np.float32)), None),
        (fits.BinTableHDU(rows), "announces 67.1 MB in a file of"),
    ):
        path.write_bytes(gzip.compress(_fits(hdu), 1))
        with nullcontext() if words is None else pytest.raises(FormatError, match=words):
            raw, budget = read_unpacked(path)
            assert open_fits(raw, budget)[1].data.shape == (4096, 4096)


def test_compressed_images_are_not_decompressed(tmp_path):
    raw = _fits(
        fits.CompImageHDU(np.zeros((100, 100))),
        fits.BinTableHDU.from_columns([fits.Column("x", "D", array=[1.0])]),
    )
    assert type(open_fits(raw, Budget("a.fits", len(raw)))[1]) is fits.BinTableHDU
    (tmp_path / "a.fits").write_bytes(raw)
    assert read_table(tmp_path / "a.fits").colnames == ["x"]


def test_rows_of_fits_without_bytes(tmp_path):
    raw = _fits(fits.BinTableHDU.from_columns([fits.Column("x", "D", array=[1.0, 2.0])]))
    for keyword, old, new in [
        ("NAXIS1  ", "8", "0"), ("NAXIS2  ", "2", "9000000000"), ("TFORM1  ", "'D ", "'0D")
    ]:  # fmt: skip
        before, after = (f"{keyword}= {text:>{20 if old.isdigit() else 0}}" for text in (old, new))
        assert before.encode() in raw
        raw = raw.replace(before.encode(), after.encode())
    (tmp_path / "a.fits").write_bytes(raw)
    with pytest.raises(FormatError, match="announces 9000000000 rows"):
        read_table(tmp_path / "a.fits")


def test_arrays_of_fits_that_share_one_place(tmp_path):
    """Each of 1000 rows states the same array of 1000 numbers."""
    arrays = np.empty(1000, object)
    arrays[:] = [np.arange(1000.0) if k == 0 else np.zeros(0) for k in range(1000)]
    hdu = fits.BinTableHDU.from_columns([fits.Column("x", "PD()", array=arrays)])
    raw = bytearray(_fits(hdu))
    first = raw.index((1000).to_bytes(4) + bytes(4), 5760)
    for k in range(1000):
        raw[first + 8 * k : first + 8 * k + 8] = raw[first : first + 8]
    (tmp_path / "a.fits").write_bytes(raw)
    with pytest.raises(FormatError, match="announces 8 MB"):
        read_table(tmp_path / "a.fits", FileLimits(content=10**6))
    # read as a product, whose budget is not given
    assert len(Content("a.fits", bytes(raw)).hdus[1].rows) == 1000
    for k in range(1000):
        raw[first + 8 * k : first + 8 * k + 4] = (25_000).to_bytes(4)
    with pytest.raises(FormatError, match="announces 200 MB"):
        Content("a.fits", bytes(raw)).hdus[1].rows  # noqa: B018


# -- VOTables -------------------------------------------------------------------------------------


def _votable(path: Path, *, binary: bool = False) -> str:
    table = Table({"x": np.arange(50.0), "y": np.arange(50.0)})
    table.write(path, format="votable", overwrite=True,
                tabledata_format="binary" if binary else "tabledata")  # fmt: skip
    return path.read_text()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "iso-8859-1"])
@pytest.mark.parametrize("codec", [None, *COMPRESS])
def test_a_votable_in_any_encoding_and_codec(encoding, codec, tmp_path):
    path = tmp_path / "a.vot"
    text = _votable(path).replace("utf-8", encoding, 1)
    begins = text.index("<DATA>")
    away = '<DATA><BINARY><STREAM href="{}"/></BINARY></DATA></TABLE></RESOURCE></VOTABLE>'
    for changed, words in [
        (text, None),
        (text[:begins] + away.format("file:///etc/passwd"), "its data lie elsewhere"),
        (text[:begins] + away.format("http&#58;//127.0.0.1:9/a"), "its data lie elsewhere"),
        (text.replace("?>", '?><!DOCTYPE a [<!ENTITY b "c">]>', 1), "has a document type"),
        (text.replace("?>", '?><!DOCTYPE a SYSTEM "file:///dev/zero">', 1), "has a document type"),
        (text.replace("<TABLE", '<TABLE nrows="&#57;000000000"', 1), "announces 9000000000 rows"),
        (text.replace("<TABLE", '<TABLE nrows="9e9"', 1), r"\(nrows\) is '9e9'"),
        (text.replace("<TABLE", '<TABLE nrows=""', 1), r"\(nrows\) is ''"),
        (text.replace('datatype="double"', 'datatype="double" arraysize="99999"', 1), "announces"),
    ]:
        raw = changed.encode(encoding)
        path.write_bytes(raw if codec is None else COMPRESS[codec](raw))
        if words is None:
            assert list(read_table(path)["x"]) == list(range(50))
            continue
        with pytest.raises(FormatError, match=words):
            read_table(path)


def test_sizes_of_a_votable(tmp_path):
    path, none = tmp_path / "a.vot", {"rows_per_byte": 0, "cells_per_byte": 0}
    for binary in (False, True):
        _votable(path, binary=binary)
        assert len(read_table(path)) == 50
        for limits, words in [
            (FileLimits(rows=40, **none), r"holds \d+ rows"),
            (FileLimits(cells=80, **none), "cells in a file of"),
            (FileLimits(columns=1), "has more than 1 columns"),
            (FileLimits(depth=2), "has more than 2 elements within each other"),
            (FileLimits(nodes=3), "has more than 3 elements"),
            (FileLimits(seconds=0, seconds_per_byte=0), "takes more than"),
        ]:
            with pytest.raises(FormatError, match=words):
                read_table(path, limits)


def test_texts_of_a_great_width(tmp_path):
    """Reading a VOTable begins with memory for 256 rows."""
    path = tmp_path / "a.vot"
    fields = '<FIELD name="{}" datatype="char" arraysize="4000"/>'
    text = _votable(path).replace("<DATA>", "{}<DATA>")
    text = re.sub(r"</TR>", 20 * "<TD>a b</TD>" + "</TR>", text)
    path.write_text(text.format("".join(fields.format(f"t{k}") for k in range(20))))
    assert list(read_table(path)["t19"]) == 50 * ["a b"]
    path.write_text(text.format("".join(fields.format(f"t{k}") for k in range(40))))
    with pytest.raises(FormatError, match="announces 139 MB"):
        read_table(path)


def test_binary_rows_of_no_bytes(tmp_path):
    """Reading them would never end."""
    path = tmp_path / "a.vot"
    text = _votable(path, binary=True)
    path.write_text(text.replace('datatype="double"', 'datatype="double" arraysize="0"'))
    with pytest.raises(FormatError, match="has rows of zero bytes"):
        read_table(path)


def test_arrays_of_many_that_share_a_dimension(tmp_path):
    """A dimension refers to each of them: these references are no bomb, however large the file."""
    path = tmp_path / "a.nc"
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"star": 50}
        for k in range(40):
            file.create_variable(f"v{k}", ("star",), float)[:] = k
    limits = FileLimits(content=500_000, content_per_byte=0)
    assert path.stat().st_size * 40 > limits.content
    assert netcdf_groups(path, limits=limits)


def test_a_table_of_six_thousand_columns(tmp_path):
    path = tmp_path / "a.csv"
    row = ",".join(["0.1234567890123456"] * 6000)
    path.write_text(f"{','.join(f'c{k}' for k in range(6000))}\n{row}\n{row}\n")
    assert len(read_table(path).colnames) == 6000
