"""Shards beyond the budget come back from the scratch file bit for bit; a full disk is named."""

from __future__ import annotations

import gc
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.infer import Compute, GaussianPriors, OutlierMixture, fit_linear, load
from bayesdist.infer.density.target import Target
from bayesdist.infer.stars import shards as store
from bayesdist.infer.stars.shards import Store
from tests.batched import in_batches

from ..support import TWO_CHIPS, pieces, simulated, stars_of

pytestmark = pytest.mark.usefixtures("one_thread")

COLUMNS = ("X", "Y", "u", "v", "var_u", "var_v")


@pytest.fixture(scope="module")
def campaign():
    rng = np.random.default_rng(1)
    return simulated(
        101,
        900,
        order=3,
        frames="shift",
        n_exposures=3,
        chips=TWO_CHIPS,
        fraction=0.05,
        sigma=tuple(rng.uniform(0.02, 0.1, (2, 900))),
    )


@pytest.fixture
def shards(campaign):
    model, matches, _ = campaign
    cuts = pieces(900, [100, 101, 600])
    return [stars_of(model, matches.select(rows)) for rows in cuts]


def same(one, two) -> None:
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        assert getattr(one, name).dtype == getattr(two, name).dtype
        assert getattr(one, name).flags.c_contiguous
    np.testing.assert_array_equal(one.starts, two.starts)
    np.testing.assert_array_equal(one.blocks, two.blocks)
    np.testing.assert_array_equal(one.pieces, two.pieces)
    assert one.groups.same(two.groups) and one.model is two.model and len(one) == len(two)


@pytest.mark.parametrize("kept", [0, 1, 2, 4])
def test_shards_come_back_in_their_order_bit_for_bit(shards, kept):
    budget = sum(s.nbytes for s in shards[:kept])
    box = Store(budget)
    for stars in shards:
        box.add(stars)
    assert len(box) == 4
    for _ in range(2):  # again and again
        for stars, again in zip(shards, box, strict=True):
            same(stars, again)
    held = [again for again, stars in zip(box, shards, strict=True) if again is stars]
    # a small one may still fit where a large one did not
    assert len(held) >= kept and (kept == 4 or len(held) < 4)
    assert sum(stars.nbytes for stars in held) <= budget
    box.close()


def test_shards_may_be_read_while_others_are_added(shards):
    box = Store(0)
    for k, stars in enumerate(shards, start=1):
        box.add(stars)
        same(shards[0], next(iter(box)))  # the file now stands behind the first
        for one, again in zip(shards[:k], box, strict=True):
            same(one, again)
        next(iter(box))
    box.close()


def test_equal_errors_are_kept_once_in_memory_and_come_back_as_both(campaign):
    model, matches, _ = campaign
    stars = stars_of(model, matches.with_errors((0.05, 0.05)))
    assert stars.var_u is stars.var_v and stars.nbytes == 5 * 8 * 900
    assert stars_of(model, matches).nbytes == 6 * 8 * 900
    box = Store(0)
    box.add(stars)
    (again,) = box
    same(stars, again)


def test_nothing_is_left_behind(shards, tmp_path, monkeypatch):
    """The scratch file has no name, and is closed with its shards: by hand or by itself."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for by_hand in (True, False):
        before = len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").is_dir() else 0
        box = Store(0)
        box.add(shards[0])
        assert list(tmp_path.iterdir()) == []
        if by_hand:
            box.close()
            box.close()
            assert len(box) == 0 and list(box) == []
        del box
        gc.collect()  # an open file that is dropped would warn, and warnings are errors here
        after = len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").is_dir() else 0
        assert after == before


def test_a_disk_that_takes_only_a_part_at_a_time(shards, monkeypatch):
    """A write may take fewer bytes than it is given, and says so."""

    class Slow:
        def __init__(self, file):
            self.file = file

        def write(self, view):
            return self.file.write(view[: max(1, len(view) // 3)])

        def __getattr__(self, name):
            return getattr(self.file, name)

    real = tempfile.TemporaryFile
    monkeypatch.setattr(store.tempfile, "TemporaryFile", lambda **k: Slow(real(**k)))
    box = Store(0)
    for stars in shards:
        box.add(stars)
    for stars, again in zip(shards, box, strict=True):
        same(stars, again)
    box.close()


def test_a_scratch_file_that_was_cut_is_not_read_as_data(shards):
    box = Store(0)
    box.add(shards[0])
    box._file.truncate(shards[0].nbytes - 8)
    with pytest.raises(InputError, match="scratch file has been truncated"):
        list(box)
    box.close()


def test_a_full_scratch_disk_is_one_sentence(shards, tmp_path, monkeypatch):
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=32k", "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command, so no small disk can be made")
    if done.returncode:
        pytest.skip(f"no tmpfs may be mounted here ({done.stderr.strip()})")
    try:
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        box = Store(0)
        box.add(shards[0])  # 5 kB fit, 43 kB in all do not
        box.add(shards[1])
        with pytest.raises(InputError) as caught:
            for stars in shards[2:]:
                box.add(stars)
        message = str(caught.value)
        assert message.startswith(f"{folder}: the stars do not fit into the scratch folder")
        assert "No space left on device" in message and "TMPDIR" in message
        assert "compute.memory_mb" in message and "\n" not in message
        # what was kept before is still there
        assert 2 <= len(box) < 4
        for stars, again in zip(shards[: len(box)], box, strict=True):
            same(stars, again)
        box.close()
    finally:
        gc.collect()
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_scratch_folder_that_is_not_there_is_one_sentence(shards, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(InputError, match="gone: the stars do not fit into the scratch folder"):
        Store(0).add(shards[0])


def test_the_fit_and_the_density_do_not_depend_on_the_budget(campaign):
    """memory_mb = 0: everything from the scratch file, at every pass."""
    model, matches, _ = campaign
    matches = in_batches(matches, 300)
    mixture = OutlierMixture()
    fits, densities, expansions = [], [], []
    for memory_mb in (1000.0, 0.02, 0.0):
        shards = load(model, matches, Compute(memory_mb=memory_mb))
        in_file = sum(place is not None for _, place in shards._store._kept)
        assert in_file == {1000.0: 0, 0.02: 2, 0.0: 3}[memory_mb]
        fit = fit_linear(shards, model)
        fits.append(fit)
        target = Target(shards, mixture, GaussianPriors.none(model))
        psi = np.concatenate([fits[0].mean, [-4.0, -3.0, -0.2]])
        densities.append(target.log_density(np.array([psi, psi + 1e-3])))
        value, gradient, matrix = target.expand(psi)
        expansions.append((value, gradient, matrix.dense()))
        shards.close()
    for fit, density, expansion in zip(fits[1:], densities[1:], expansions[1:], strict=True):
        for name in ("mean", "cov", "chi2", "rms_u", "n_used", "rms_rejected"):
            np.testing.assert_array_equal(getattr(fit, name), getattr(fits[0], name))
        np.testing.assert_array_equal(density, densities[0])
        for one, two in zip(expansion, expansions[0], strict=True):
            np.testing.assert_array_equal(one, two)
    # and through the public way in, which opens and closes the scratch file by itself
    again = fit_linear(matches, model, compute=Compute(memory_mb=0))
    np.testing.assert_array_equal(again.mean, fits[0].mean)
