from __future__ import annotations

import errno
import hashlib

import pytest

from bayesdist.errors import InputError
from bayesdist.files.atomic import atomic_path, made_folder, sha256_of


def test_a_file_appears_only_when_the_block_succeeds(tmp_path):
    target = tmp_path / "fit.tar.gz"
    with atomic_path(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.endswith("fit.tar.gz")
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert [p.name for p in tmp_path.iterdir()] == ["fit.tar.gz"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "fit.nc"
    target.write_text("old")
    with pytest.raises(ZeroDivisionError), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert target.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_full_disk_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match=r"fit\.nc: cannot be written \(No space left"):
        with atomic_path(tmp_path / "fit.nc") as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="No such file or directory"):
        with atomic_path(tmp_path / "none" / "fit.nc") as temporary:
            temporary.write_text("x")


def test_an_error_about_another_file_passes_unchanged(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "out.txt") as temporary:
        temporary.write_text((tmp_path / "input.txt").read_text())


def test_a_folder_is_made_with_those_above_it(tmp_path):
    for _ in range(2):  # one that is there is as good
        assert made_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
        assert (tmp_path / "a" / "b").is_dir()


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "a").write_text("a file")
    with pytest.raises(InputError, match=r"a/b: the folder cannot be made \(Not a directory\); "):
        made_folder(tmp_path / "a" / "b")


def test_sha256(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert sha256_of(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    path.write_bytes(b"x" * 3_000_000)
    assert sha256_of(path) == hashlib.sha256(b"x" * 3_000_000).hexdigest()
    with pytest.raises(InputError, match="does not exist"):
        sha256_of(tmp_path / "none")
