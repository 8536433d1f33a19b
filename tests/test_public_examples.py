"""The public face is documented: parameters, what is returned and refused, examples."""

from __future__ import annotations

import doctest
import inspect

import numpy as np
import pytest
from numpydoc.docscrape import NumpyDocString

import bayesdist as bd
import bayesdist.data
import bayesdist.formats
import bayesdist.missions.wise
import bayesdist.model
import bayesdist.simulate

PUBLIC = {name: bd for name in bd.__all__ if name != "__version__"}
PUBLIC |= dict.fromkeys(bayesdist.formats.__all__, bayesdist.formats)
PUBLIC |= {n: bayesdist.missions.wise for n in bayesdist.missions.wise.__all__ if n != "PLUGIN"}
PUBLIC |= {
    "PolynomialBasis": bayesdist.model,
    "simulate_partitioned": bayesdist.simulate,
    "write_partitioned": bayesdist.data,
}


@pytest.mark.parametrize("name", PUBLIC)
def test_examples_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    thing = getattr(PUBLIC[name], name)
    found = doctest.DocTestFinder(recurse=False).find(thing, name, globs={"bd": bd, "np": np})
    assert found and found[0].examples, f"{name} has no example"
    written = []
    runner = doctest.DocTestRunner(verbose=False)
    failed = runner.run(found[0], out=written.append).failed
    assert not failed, "".join(written)
    assert not any(doctest.SKIP in example.options for example in found[0].examples)


@pytest.mark.parametrize("name", PUBLIC)
def test_parameters_are_those_of_the_signature(name):
    thing = getattr(PUBLIC[name], name)
    text = NumpyDocString(inspect.getdoc(thing))
    asked = {
        ("**" if one.kind is one.VAR_KEYWORD else "") + one.name
        for one in inspect.signature(thing).parameters.values()
    }
    told = {
        part.strip().replace("\\", "") for one in text["Parameters"] for part in one.name.split(",")
    }
    assert told == asked
    if inspect.isfunction(thing):
        assert text["Raises"] or not asked
        returns = inspect.signature(thing).return_annotation
        assert bool(text["Returns"]) == (returns != "None")


@pytest.mark.parametrize("name", ["from_solution", "to_sky", "write"])
def test_methods_of_a_calibration_are_documented(name, tmp_path, monkeypatch):
    """Parameters as in the signature, and examples that run where there are some."""
    monkeypatch.chdir(tmp_path)
    method = getattr(bd.Calibration, name)
    text = NumpyDocString(inspect.getdoc(method))
    told = {p.strip().lstrip("*") for one in text["Parameters"] for p in one.name.split(",")}
    assert told == set(inspect.signature(method).parameters) - {"self"}
    for example in doctest.DocTestFinder(recurse=False).find(
        inspect.unwrap(method), name, globs={"bd": bd, "np": np}
    ):
        written = []
        assert not doctest.DocTestRunner(verbose=False).run(example, out=written.append).failed, (
            "".join(written)
        )
