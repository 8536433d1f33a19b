"""A format of a plugin: it is recognized, read, checked and built."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from numpy.testing import assert_allclose

from bayesdist.errors import FormatError, InputError
from bayesdist.plugin import SELECTION
from bayesdist.products import registry
from bayesdist.products.common.content import Content
from tests.toy import Toy, forget, toy_installed


@pytest.fixture
def file(tmp_path) -> Iterator[Path]:
    """A file of the toy format, which is installed."""
    path = tmp_path / "a.json"
    path.write_text('{"toy": {"scale": 0.05, "bend": 1e-6}}')
    with toy_installed(tmp_path):
        yield path


def test_a_file_of_the_format_is_read(file):
    assert registry.describe(file) == "toy of scale 0.05"
    assert registry.lint(file) == ()
    chip = registry.read_calibration(file).chip()
    assert_allclose(chip.at([600.0], [500.0])[:, 0], [0.05 * (100 + 1e-6 * 1e4), 5.0], rtol=1e-9)


def test_findings_and_damage_are_stated(tmp_path, file):
    file.write_text('{"toy": {"scale": -0.05, "bend": 0}}')
    assert [finding.where for finding in registry.lint(file)] == ["scale"]
    file.write_text('{"toy": {"scale": "x"}}')
    with pytest.raises(FormatError, match="is no toy"):
        registry.open_document(file)


def test_a_built_file_holds_the_calibration(file):
    settings = registry.product_settings()["toy"]()
    [built] = registry.build("toy", registry.read_calibration(file), settings)
    toy = registry.recognized(Content(built.file_name, built.content)).holds
    assert isinstance(toy, Toy)
    assert_allclose([toy.scale, toy.bend], [0.05, 1e-6], rtol=1e-9)


def test_the_format_is_listed(file):
    row = registry.list_formats()
    row.add_index("name")
    assert row.loc["toy"]["title"] == "toy" and row.loc["toy"]["written"]


def test_without_plugins_no_format_is_understood(tmp_path, monkeypatch):
    """The error says why, instead of a list without entries."""
    monkeypatch.setenv(SELECTION, "")
    forget()
    try:
        (tmp_path / "a.txt").write_text("text")
        with pytest.raises(InputError, match=f"none is installed, or {SELECTION}"):
            registry.open_document(tmp_path / "a.txt")
        with pytest.raises(InputError, match="no format 'toy'"):
            registry.format_of("toy")
    finally:
        monkeypatch.undo()
        forget()
