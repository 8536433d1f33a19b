"""A small campaign that may be damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from bayesdist.files.tables import read_table
from tests.app.support import cli, edit, good, one_sentence, refused, snapshot, summary_of

CONFIG = "campaign_f606w.toml"
ONE = "f606w-004"  # the exposure that is damaged; the break is between it and f606w-005
DRIFT = ("[model.tdd]", "[assess]")


class Campaign:
    """A copy that may be damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def replaced(self, old: str, new: str) -> Campaign:
        """The same with another configuration."""
        edit(self.path / CONFIG, {old: new})
        return self

    def without_drift(self) -> Campaign:
        text = (self.path / CONFIG).read_text(encoding="utf-8")
        begin, end = (text.index(key) for key in DRIFT)
        text = text[:begin] + text[end:].replace("segment = 1", "segment = 0")
        (self.path / CONFIG).write_text(text, encoding="utf-8")
        return self

    def log(self, change: Callable[[Table], Table | None]) -> Campaign:
        """The same with another log."""
        path = self.path / "exposures.ecsv"
        table = Table.read(path)
        found = change(table)
        (table if found is None else found).write(path, overwrite=True)
        return self

    def keep(self, *numbers: int) -> Campaign:
        """Only these exposures, from 1."""
        return self.log(lambda t: t[np.array(numbers) - 1])

    def catalog(self, change: Callable[[Table], Table | None]) -> Campaign:
        table = read_table(self.path / "catalog.parquet")
        found = change(table)
        table = table if found is None else found
        table.meta = {}
        (self.path / "catalog.parquet").unlink()
        table.write(self.path / "catalog.ecsv")
        return self.replaced("catalog.parquet", "catalog.ecsv")

    def lists(self, change: Callable[[Table], Table | None], *names: str) -> Campaign:
        """Lists of these exposures, of all where none is named, changed."""
        for path in sorted((self.path / "lists").iterdir()):
            if names and path.stem not in names:
                continue
            table = read_table(path)
            found = change(table)
            table = table if found is None else found
            table.meta = {}
            table.write(path, overwrite=True)
        return self

    def start(self, change: Callable[[fits.FITS_rec], None]) -> Campaign:
        with fits.open(self.path / "start_idc.fits", mode="update") as file:
            change(file[1].data)
        return self

    def refused(self, *words: str) -> str:
        """`check` and `run` both refuse it with one sentence, and nothing is left."""
        config, out = self.path / CONFIG, self.path.parent / "run"
        refused(self.path.parent, "check", config, words=words)
        return refused(self.path.parent, "run", config, "-o", out, words=words)

    def check(self) -> str:
        before = snapshot(self.path)
        text = good("check", self.path / CONFIG).out
        assert snapshot(self.path) == before
        return text

    def begun(self) -> Path:
        """A folder that becomes a run by its first stage."""
        run = self.path.parent / "run"
        run.mkdir()
        text = (self.path / CONFIG).read_text(encoding="utf-8")
        for name in ("catalog.parquet", "catalog.ecsv", "exposures.ecsv", "start_idc.fits"):
            text = text.replace(f'"{name}"', f'"{self.path / name}"')
        text = text.replace('lists = "lists"', f'lists = "{self.path / "lists"}"')
        (run / "config.toml").write_text(text, encoding="utf-8")
        return run

    def matched(self) -> dict:
        """Section 'matching' of the summary after the first stage."""
        run = self.begun()
        good("stage", "match", run, "-q")
        return summary_of(run)["matching"]

    def unmatched(self, *words: str) -> str:
        """The first stage stops with one sentence; nothing is there that looks like a result."""
        run = self.begun()
        result = cli("stage", "match", run, "-q")
        assert result.code == 1, result.err
        one_sentence(result.err, *words)
        assert {p.name for p in run.iterdir()} == {"config.toml", "run.json", "bayesdist.log"}
        return result.err


def masked(name: str, row: int) -> Callable[[Table], None]:
    def change(table: Table) -> None:
        mask = np.arange(len(table)) == row - 1
        table[name] = np.ma.masked_array(np.asarray(table[name]), mask=mask)

    return change


def setting(name: str, row: int | slice, value: object) -> Callable[[Table], None]:
    def change(table: Table) -> None:
        table[name][row if isinstance(row, slice) else row - 1] = value

    return change


def scattered(table: Table) -> None:
    """Detections of no sky."""
    rng = np.random.default_rng(5)
    table["x"], table["y"] = rng.uniform(1, (4096, 2048), (len(table), 2)).T
