"""A disk that fills while a run is written: one sentence, and --resume goes on afterwards."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest

from bayesdist.app.stages import run
from bayesdist.infer import load_posterior
from tests.app.support import cli, one_sentence, process, snapshot, write_job
from tests.reduced import only_in_full


class SmallDisk:
    """A tmpfs of a given size."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir()
        self._mount("size=512k")

    def _mount(self, options: str) -> None:
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(self.path)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            pytest.skip("there is no mount command, so no small disk can be made")
        if done.returncode:
            pytest.skip(f"no tmpfs may be mounted here ({done.stderr.strip()})")

    def resize(self, size: int | str) -> None:
        self._mount(f"remount,size={size}")

    def leave(self, free: int) -> None:
        """Change the size so that so many bytes are free."""
        self.resize(shutil.disk_usage(self.path).used + free)


@pytest.fixture
def disk(tmp_path):
    small = SmallDisk(tmp_path / "disk")
    yield small
    subprocess.run(["umount", "-l", str(small.path)], check=True)


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Path:
    """A configuration whose sampler runs to its last step, with a checkpoint every 50."""
    return write_job(
        tmp_path_factory.mktemp("job"),
        sampler={"target_ess": 1e7, "max_steps": 100, "checkpoint_every": 50},
    )


def _refused(*arguments: object, words: tuple[str, ...]) -> None:
    """In a process of its own, which HDF5 might end when it closes what it could not write."""
    done = process(*arguments, "-q", cwd=Path.cwd())
    assert done.returncode == 1, (done.returncode, done.stderr)
    one_sentence(done.stderr, *words, "No space left on device", "make room")


def _blocks(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Content of the checkpoints."""
    out = {}
    for path in sorted(folder.glob("chain-*.h5")):
        with h5py.File(path, "r") as file:
            out[path.name] = {name: file[name][...] for name in file}
    return out


def _assert_same_draws(a: Path, b: Path) -> None:
    one, other = load_posterior(a), load_posterior(b)
    np.testing.assert_array_equal(one.theta, other.theta)
    np.testing.assert_array_equal(one.log_prob, other.log_prob)
    assert one.hyper.keys() == other.hyper.keys()
    for key, values in one.hyper.items():
        np.testing.assert_array_equal(values, other.hyper[key])


@pytest.fixture(scope="module")
def undisturbed(job, tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bayesdist.app.stages.report", lambda results, pdf: [])
        return run(job, tmp_path_factory.mktemp("undisturbed") / "run")


def test_while_checkpointing(job, undisturbed, disk, no_report):
    path = disk.path / "run"
    _refused("run", job, "-o", path, words=(str(path / "chain-"),))
    whole, blocks = _blocks(undisturbed), _blocks(path)
    assert 1 < len(blocks) < len(whole)  # it happened between two checkpoints
    for name, content in blocks.items():
        for key, values in content.items():
            np.testing.assert_array_equal(values, whole[name][key])
    assert not list(path.glob(".*")) and not (path / "posterior.nc").exists()

    disk.resize(200_000_000)
    result = cli("run", job, "-o", path, "--resume", "-q")
    assert result.code == 0 and "NOT CONVERGED" in result.err
    _assert_same_draws(undisturbed, path)


@pytest.mark.slow
@only_in_full("the disk fills between two checkpoints")
def test_while_the_posterior_is_written(job, undisturbed, disk, no_report):
    path = disk.path / "run"
    disk.resize(200_000_000)
    shutil.copytree(undisturbed, path, ignore=shutil.ignore_patterns("posterior.nc"))
    before = snapshot(path)
    disk.leave(300_000)  # room for notes, not for the draws
    _refused("stage", "sample", path, words=("posterior.nc",))
    after = snapshot(path)
    assert {k: v for k, v in after.items() if k.startswith("chain-")} == {
        k: v for k, v in before.items() if k.startswith("chain-")
    }
    assert not list(path.glob(".*")) and not (path / "posterior.nc").exists()

    disk.resize(200_000_000)
    assert cli("run", job, "-o", path, "--resume", "-q").code == 0
    _assert_same_draws(undisturbed, path)


@only_in_full("test_while_checkpointing fills the disk later")
def test_while_the_first_checkpoints_are_written(job, disk):
    """HDF5 must not end the process as it closes what it could not write."""
    path = disk.path / "run"
    for size in ("180k", "240k", "300k"):
        disk.resize(size)
        _refused("run", job, "-o", path, "--force", words=(str(path),))
        assert not list(path.glob(".*"))


def test_from_the_start(job, disk):
    """Before anything of HDF5 is opened."""
    (disk.path / "ballast").write_bytes(b"x" * 4096)
    disk.leave(0)
    result = cli("run", job, "-o", disk.path / "run", "-q")
    assert result.code == 1, result.err
    one_sentence(result.err, str(disk.path / "run"), "No space left on device", "make room")
    assert [p.name for p in disk.path.rglob("*") if p.is_file()] == ["ballast"]
