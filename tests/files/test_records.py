"""Records as arrays: what is read back is equal to the last bit."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from types import FrameType
from typing import Any

import numpy as np
import pytest

from bayesdist.assess import Requirement
from bayesdist.errors import FormatError, InputError
from bayesdist.files.hdf5 import (
    read_record,
    record_from_arrays,
    record_to_arrays,
    write_record,
)
from bayesdist.model import Chip, DistortionModel

MODEL = DistortionModel(2, (Chip(1, "A", (100.0, 80.0), (50.5, 40.5)),))


def back(value: Any) -> Any:
    return record_from_arrays(record_to_arrays(value))


def test_numbers_texts_and_containers_stay_what_they_are():
    value = {"a": (1, 2.5, None, True), ("u", 3): [float("inf"), "text"], "b": np.float64(0.1)}
    found = back(value)
    assert found == value
    assert isinstance(found["a"], tuple) and isinstance(found[("u", 3)], list)


def test_arrays_are_equal_to_the_last_bit_and_are_written_once():
    values = np.random.default_rng(1).normal(size=(3, 4)).astype(np.float32)
    arrays = record_to_arrays((values, values))
    assert len(arrays) == 2  # and the tree
    first, second = record_from_arrays(arrays)
    np.testing.assert_array_equal(first, values)
    assert first.dtype == np.float32 and second is first
    np.testing.assert_array_equal(back(np.array(["ab", "c"])), ["ab", "c"])


def test_dataclasses_and_models_are_made_again():
    asked = Requirement("r", "rms", 1.0, region=[(0, 0), (9, 0), (9, 9)], chip=1)
    assert back(asked) == asked
    one, other = back((MODEL, DistortionModel.from_dict(MODEL.to_dict())))
    assert one.to_dict() == MODEL.to_dict() and one is other


@pytest.mark.parametrize("kept", [0, 0.5, 0.9])
def test_a_damaged_file_is_called_what_it_has_to_be(tmp_path, kept):
    path = tmp_path / "record.h5"
    write_record(path, {"a": np.arange(1000.0)}, "mark")
    os.truncate(path, int(kept * path.stat().st_size))
    with pytest.raises(FormatError, match=r"record\.h5: this is not an evaluation .*; fit again"):
        read_record(path, dict, "an evaluation", do="fit again", fingerprint="mark")


def test_a_file_is_not_damaged_where_its_reader_is_interrupted(tmp_path):
    """HDF5 calls back to list the attributes; interrupted there, it fails with a SystemError."""

    def interrupt(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_name == "iter_cb":
            sys.setprofile(None)
            raise KeyboardInterrupt

    path = tmp_path / "record.h5"
    write_record(path, {"a": 1})
    sys.setprofile(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt) as found:
            read_record(path, dict, "an evaluation", do="fit again")
    finally:
        sys.setprofile(None)
    assert isinstance(found.value.__cause__, SystemError)
    assert read_record(path, dict, "an evaluation", do="fit again") == {"a": 1}


def test_an_interrupt_that_a_script_is_handling_is_none_of_the_file(tmp_path):
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        with pytest.raises(InputError, match="does not exist"):
            read_record(tmp_path / "none.h5", dict, "an evaluation", do="fit again")


def test_a_file_of_other_data_and_none_are_not_called_damaged(tmp_path):
    path, what = tmp_path / "record.h5", {"what": "an evaluation", "do": "fit again"}
    with pytest.raises(InputError, match=r"record\.h5: does not exist; fit again") as found:
        read_record(path, dict, **what)
    assert not isinstance(found.value, FormatError)
    write_record(path, {"a": 1}, "mark")
    assert read_record(path, dict, **what, fingerprint="mark") == {"a": 1}
    with pytest.raises(InputError, match=r"record\.h5: this is an evaluation of other") as found:
        read_record(path, dict, **what, fingerprint="another")
    assert not isinstance(found.value, FormatError)


def test_what_cannot_be_written_is_refused():
    with pytest.raises(TypeError, match="cannot be written"):
        record_to_arrays({"f": len})


@dataclass(frozen=True)
class Foreign:
    """A class that is not of the package."""

    a: int


def test_classes_of_others_are_made_from_files_only_if_their_package_is_named():
    arrays = record_to_arrays(Foreign(1))
    with pytest.raises(TypeError, match="not a class of the records of bayesdist"):
        record_from_arrays(arrays)
    with pytest.raises(TypeError, match="not a class of the records of bayesdist, test"):
        record_from_arrays(arrays, packages=["test"])
    assert record_from_arrays(arrays, packages=["tests"]) == Foreign(1)
