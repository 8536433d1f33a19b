"""What is wrong deep in a folder of Parquet: one sentence with file, row group and row, exit 1.

Nothing half-written stays, however late the fault shows.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bayesdist.app import stages
from bayesdist.kinds.matches.sources import load_matches
from tests.app.support import (
    begin_stagewise,
    model_of,
    one_sentence,
    process,
    refused,
    truth_of,
    write_config,
)
from tests.reduced import only_in_full

N, PART, GROUP = 20_000, 10_000, 1_000


@pytest.fixture(scope="module")
def stars() -> pa.Table:
    model = model_of()
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0.5, 1000.5, N), rng.uniform(0.5, 800.5, N)
    u, v = model.predict(truth_of(model), x, y).T + 0.02 * rng.normal(size=(2, N))
    sigma = np.full(N, 0.02)
    columns = {"x": x, "y": y, "u": u, "v": v, "sigma_u": sigma, "sigma_v": sigma}
    fields = [pa.field(name, pa.float64(), metadata={"unit": "pix"}) for name in columns]
    return pa.table(list(columns.values()), schema=pa.schema(fields))


def write(path: Path, table: pa.Table) -> None:
    pq.write_table(table, path, row_group_size=GROUP, write_page_checksum=True, compression="none")


@pytest.fixture
def job(tmp_path, stars) -> Path:
    """Two parts of ten row groups each, and a configuration."""
    (tmp_path / "stars").mkdir()
    for k in range(2):
        write(tmp_path / "stars" / f"{'ab'[k]}.parquet", stars.slice(k * PART, PART))
    return write_config(tmp_path / "c.toml", data={"matches": "stars", "rows_in_memory": PART})


Change = Callable[[pa.Table], pa.Table]


def _value(name: str, row: int, value: float) -> Change:
    def change(table: pa.Table) -> pa.Table:
        values = table[name].to_numpy().copy()
        values[row - 1] = value
        k = table.column_names.index(name)
        return table.set_column(k, table.schema.field(name), pa.array(values))

    return change


def _null(name: str, row: int) -> Change:
    def change(table: pa.Table) -> pa.Table:
        values = table[name].to_pylist()
        values[row - 1] = None
        k = table.column_names.index(name)
        return table.set_column(k, table.schema.field(name), pa.array(values))

    return change


def _text(name: str) -> Change:
    def change(table: pa.Table) -> pa.Table:
        values = [f"{value:.6f}" for value in table[name].to_pylist()]
        values[6666] = "12.3.4"
        return table.set_column(table.column_names.index(name), name, pa.array(values))

    return change


def _repeated(table: pa.Table) -> pa.Table:
    return pa.concat_tables([table.slice(0, PART - 1), table.slice(777, 1)])


def _unit(table: pa.Table) -> pa.Table:
    fields = [
        field.with_metadata({"unit": "mas"}) if field.name in ("u", "v") else field
        for field in table.schema
    ]
    return table.cast(pa.schema(fields))


# what is done to the second part, and what the sentence has to name
CASES: dict[str, tuple[Change, list[str]]] = {
    "not a number": (
        _value("u", 6_667, np.nan), ["b.parquet, row group 7 of 10, row 6667", "'u'", "nan"]
    ),
    "infinite": (_value("y", 10_000, np.inf), ["row group 10 of 10, row 10000", "'y'", "inf"]),
    "no error": (_value("sigma_v", 1_001, 0.0), ["row group 2 of 10, row 1001", "'sigma_v'"]),
    "null": (_null("v", 2_345), ["b.parquet, row group 3 of 10, row 2345", "'v'"]),
    "text": (_text("x"), ["b.parquet", "'x'"]),
    "outside": (_value("x", 4_000, 1200.0), ["row 4000", "b.parquet", "1200.00", "1000 x 800"]),
    "no column": (lambda t: t.drop_columns("sigma_u"), ["b.parquet", "'sigma_u'"]),
    "no errors": (
        lambda t: t.drop_columns(["sigma_u", "sigma_v"]), ["b.parquet", "a.parquet", "'sigma_u'"]
    ),
    "other names": (lambda t: t.rename_columns([f"c{k}" for k in range(6)]), ["b.parquet"]),
    "other unit": (_unit, ["b.parquet", "a.parquet", "mas", "pix"]),
    "twice": (
        _repeated,
        ["b.parquet, row group 10 of 10, row 10000", "b.parquet, row group 1 of 10, row 778"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_wrong_part(job, stars, case):
    change, words = CASES[case]
    write(job.parent / "stars" / "b.parquet", change(stars.slice(PART)))
    refused(job.parent, "run", job, "-o", job.parent / "run", words=words)
    refused(job.parent, "check", job, words=words)


def _flip(path: Path, group: int, column: int) -> None:
    """Another bit in the middle of the values of a column in a row group, both counted from 0."""
    chunk = pq.ParquetFile(path).metadata.row_group(group).column(column)
    start = chunk.dictionary_page_offset if chunk.has_dictionary_page else chunk.data_page_offset
    content = bytearray(path.read_bytes())
    content[start + chunk.total_compressed_size // 2] ^= 0x10
    path.write_bytes(bytes(content))


DAMAGE: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "a bit": (
        lambda p: _flip(p, 6, 3), ["b.parquet, row group 7 of 10 (rows 6001 to 7000)"]
    ),
    "half": (lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]), ["b.parquet"]),
    "empty": (lambda p: p.write_bytes(b""), ["b.parquet"]),
    "text": (lambda p: p.write_text("x,y,u,v\n1,2,3,4\n"), ["b.parquet"]),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_part(job, case, monkeypatch):
    damage, words = DAMAGE[case]
    damage(job.parent / "stars" / "b.parquet")
    refused(job.parent, "run", job, "-o", job.parent / "run", words=words)
    on_disk = partial(load_matches, rows_in_memory=PART)
    monkeypatch.setattr("bayesdist.kinds.matches.init.load_matches", on_disk)
    refused(job.parent, "init", job.parent / "new.toml", "--matches", job.parent / "stars",
            words=words)  # fmt: skip


@pytest.mark.slow
@only_in_full("test_bad_input has a shell")
def test_the_same_from_a_shell(tmp_path, stars):
    """In a process of its own."""
    (tmp_path / "stars").mkdir()
    for k in range(3):
        moved = stars.set_column(0, stars.schema.field("x"), pa.array(
            np.clip(stars["x"].to_numpy() + 1e-6 * k, 0.5, 1000.5)
        ))  # fmt: skip
        write(tmp_path / "stars" / f"{k:02d}.parquet", moved)
    _flip(tmp_path / "stars" / "02.parquet", 19, 2)
    config = write_config(tmp_path / "c.toml", data={"matches": "stars", "rows_in_memory": PART})
    done = process("run", config, "-o", tmp_path / "run", "-q", cwd=tmp_path)
    assert done.returncode == 1 and done.stdout == ""
    one_sentence(done.stderr, "02.parquet, row group 20 of 20 (rows 19001 to 20000)")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.toml", "stars"]


def test_a_part_that_is_damaged_between_two_stages(job, tmp_path):
    """The hash of the input is looked at first; the run stays as it was."""
    run = begin_stagewise_here(job, tmp_path)
    _flip(job.parent / "stars" / "b.parquet", 6, 3)
    refused(tmp_path, "stage", "sample", run, words=["b.parquet", "changed since the run began"])


def test_a_part_that_is_damaged_while_it_is_read(job, tmp_path, monkeypatch):
    """After the scan, before the passes: found when the piece is read, with its row group."""
    from bayesdist.kinds.matches import kind as stars

    model_of = stars.model_of
    path = job.parent / "stars" / "b.parquet"

    def first_damage(*arguments):
        found = model_of(*arguments)
        _flip(path, 6, 3)
        return found

    before = path.read_bytes()
    monkeypatch.setattr(stars, "model_of", first_damage)
    from tests.app.support import cli

    result = cli("run", job, "-o", tmp_path / "run")
    assert result.code == 1
    one_sentence(result.err, "b.parquet, row group 7 of 10")
    path.write_bytes(before)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@only_in_full("parts that are damaged meanwhile are run")
def test_a_part_that_vanishes_before_it_is_written_about(job, tmp_path, monkeypatch):
    """When what is said of each star is written: the draws stay, and the stage can be repeated."""
    from tests.app.support import cli, good

    run = begin_stagewise_here(job, tmp_path)
    path, kept = job.parent / "stars" / "b.parquet", tmp_path / "kept.parquet"
    real = stages._write_part

    def vanish(*arguments):
        real(*arguments)
        path.rename(kept)

    monkeypatch.setattr(stages, "_write_part", vanish)
    result = cli("stage", "sample", run, "-q")
    assert result.code == 1
    one_sentence(result.err, "b.parquet", "does not exist")
    assert [p.name for p in (run / "stars").iterdir()] == ["part-00000.parquet"]
    assert "sample" not in json.loads((run / "run.json").read_text())["stages"]
    monkeypatch.setattr(stages, "_write_part", real)
    shutil.move(kept, path)
    good("stage", "sample", run)
    parts = [pq.read_table(p) for p in sorted((run / "stars").iterdir())]
    assert sum(map(len, parts)) == N


def begin_stagewise_here(job: Path, tmp_path: Path) -> Path:
    """A run after its fit."""
    config = write_config(
        tmp_path / "full.toml", data={"matches": str(job.parent / "stars"), "rows_in_memory": PART}
    )
    return begin_stagewise(tmp_path / "run", config, "fit")
