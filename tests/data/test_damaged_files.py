"""Whatever happens to a file, the answer is a table or one clear sentence."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.data import Matches, read_catalog, read_matches
from bayesdist.errors import InputError
from bayesdist.formats.hst1pass import read_matchup


def outcome(read, path):
    """None for a table, else the sentence."""
    try:
        assert len(read(path)) > 0
    except InputError as error:
        text = str(error)
        assert path.name in text and "\n" not in text and text.endswith(".")
        return text
    return None


def some_table(rng, n=400):
    x, y = rng.uniform(1, 2048, (2, n))
    t = Table(
        {"x": x, "y": y, "u": x + 1, "v": y - 1, "su": np.full(n, 0.1), "sv": np.full(n, 0.1)}
    )
    t["exp"] = [f"e{k % 3}" for k in range(n)]
    t["u"].unit = t["v"].unit = "pix"
    return t


def read(path):
    return read_matches(path, sigma=1.0)


@pytest.mark.parametrize("suffix", ["fits", "parquet", "fits.gz"])
def test_truncated_binary_files_are_always_refused(rng, tmp_path, suffix):
    whole = tmp_path / f"whole.{suffix}"
    some_table(rng).write(whole)
    content = whole.read_bytes()
    assert outcome(read, whole) is None
    path = tmp_path / f"cut.{suffix}"
    for length in [0, 1, 10, len(content) - 1, *rng.integers(0, len(content), 60)]:
        path.write_bytes(content[:length])
        assert outcome(read, path) is not None


@pytest.mark.parametrize("suffix", ["ecsv", "csv"])
def test_truncated_text_gives_a_shorter_table_or_a_sentence(rng, tmp_path, suffix):
    whole = tmp_path / f"whole.{suffix}"
    some_table(rng, 60).write(whole, format=f"ascii.{suffix}")
    content = whole.read_bytes()
    options = {"sigma": 1.0, "unit": "pix"}
    path = tmp_path / f"cut.{suffix}"
    for length in [0, 1, 10, *rng.integers(0, len(content), 60)]:
        path.write_bytes(content[:length])
        outcome(lambda p: read_matches(p, **options), path)


@pytest.mark.parametrize("suffix", ["fits", "parquet", "ecsv", "csv"])
def test_flipped_bytes_give_a_table_or_a_sentence(rng, tmp_path, suffix):
    whole = tmp_path / f"whole.{suffix}"
    some_table(rng, 60).write(whole, **({"format": "ascii.csv"} if suffix == "csv" else {}))
    content = np.frombuffer(whole.read_bytes(), np.uint8)
    path = tmp_path / f"bad.{suffix}"
    for _ in range(60):
        damaged = content.copy()
        where = rng.integers(0, len(content), 5)
        damaged[where] = rng.integers(0, 256, 5)
        path.write_bytes(damaged.tobytes())
        outcome(read, path)


def test_one_format_under_the_name_of_another(rng, tmp_path):
    for suffix in ("fits", "parquet", "ecsv"):
        some_table(rng).write(tmp_path / f"a.{suffix}")
    for suffix in ("fits", "parquet", "ecsv", "csv"):
        for other in ("fits", "parquet", "ecsv"):
            if other == suffix or (suffix, other) == ("csv", "ecsv"):
                continue
            path = tmp_path / f"wrong_{other}.{suffix}"
            path.write_bytes((tmp_path / f"a.{other}").read_bytes())
            assert outcome(read, path) is not None


def test_truncated_real_files(data_dir, rng, tmp_path):
    uvis = data_dir / "hst1pass_uvis"
    for source, reader, always in (
        (data_dir / "anet_pairs" / "Harry695_corr.fits", read, True),
        (uvis / "ie8j01xlq_flt.uvwXYMpq", read, False),
        (uvis / "MATCHUP_XYMEEE_final", read_matchup, False),
        (data_dir / "flystar" / "my_gaia.fits", lambda p: read_catalog(p, unit="arcsec"), True),
    ):
        content = source.read_bytes()
        path = tmp_path / source.name
        for length in [0, 100, *rng.integers(0, len(content), 25)]:
            path.write_bytes(content[:length])
            # text that ends with a whole line cannot be known to be cut
            ends_well = content[:length].endswith(b"\n")
            message = outcome(reader, path)
            assert message is not None or (ends_well and not always)


def test_text_reads_as_a_table_of_the_right_type(rng, tmp_path):
    some_table(rng).write(tmp_path / "a.ecsv")
    assert isinstance(read(tmp_path / "a.ecsv"), Matches)
