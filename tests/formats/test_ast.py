"""AST mappings and parameters of gbdes: written, read, used by starlink-pyast, and faults."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from bayesdist.calibration.calibration import calibration_of
from bayesdist.errors import FormatError, InputError
from bayesdist.model import Chip, DistortionModel
from bayesdist.products import registry
from tests.app.support import good

from .support import (
    PIXEL,
    POINT,
    StandIn,
    build_into,
    on_sky,
    random_pixels,
    some_covariance,
    some_solution,
)

SIZE = (1200.0, 900.0)
write = partial(build_into, "ast")


class _Lines:
    """Source and sink of an AST channel."""

    def __init__(self, text: str = "") -> None:
        self.lines = text.splitlines()

    def astsource(self) -> str | None:
        return self.lines.pop(0) if self.lines else None

    def astsink(self, line: str) -> None:
        self.lines.append(line)


@pytest.fixture
def ast():
    return pytest.importorskip("starlink.Ast", reason="starlink-pyast is not installed")


def read_by_ast(ast, path: Path):
    return ast.Channel(_Lines(path.read_text()), None).read()


def dumped(ast, mapping) -> str:
    sink = _Lines()
    ast.Channel(None, sink).write(mapping)
    return "\n".join(sink.lines) + "\n"


@pytest.mark.parametrize("order", [1, 4, 9])
def test_ast_has_the_positions_and_the_inverse(tmp_path, ast, order):
    found = on_sky(order)
    mapping = read_by_ast(ast, write(tmp_path, found))
    x, y = random_pixels(SIZE, 2000)
    degrees = mapping.tran([x - 1, y - 1], True)
    assert np.abs(3600 * degrees.T - found.forward(x, y, chip=1)).max() / PIXEL < 1e-9
    back = mapping.tran(degrees, False)
    assert max(np.abs(back[0] + 1 - x).max(), np.abs(back[1] + 1 - y).max()) < 1e-6


def test_what_ast_writes_again_is_the_calibration(tmp_path, ast):
    """The dump of the mapping that it read, without our remarks."""
    found = on_sky(4)
    again = tmp_path / "again.txt"
    again.write_text(dumped(ast, read_by_ast(ast, write(tmp_path, found))))
    back = registry.read_calibration(again, size=SIZE)
    x, y = random_pixels(SIZE, 2000)
    off = back.forward(x, y, chip=1) - found.forward(x, y, chip=1)
    assert np.abs(off).max() / PIXEL < 1e-9
    assert back.plane.kind == "free" and back.errors == "none"


def test_what_is_read_back_is_the_calibration_with_its_covariance(tmp_path):
    found = on_sky(9)
    path = write(tmp_path, found)
    back = registry.read_calibration(path)
    assert back.errors == "covariance" and (back.plane.kind, back.plane.point) == ("sky", POINT)
    assert_allclose(back.solution.mean, found.solution.mean, rtol=0, atol=0)
    assert_allclose(back.solution.cov, found.solution.cov, rtol=0, atol=0)
    assert not registry.lint(path)
    (tmp_path / "ast_parameters.fits").unlink()
    alone = registry.read_calibration(path)
    x, y = random_pixels(SIZE, 2000)
    off = alone.forward(x, y, chip=1) - found.forward(x, y, chip=1)
    assert np.abs(off).max() / PIXEL < 1e-9 and "is not here" in alone.notes[0]


def test_chips_are_files_of_their_own(tmp_path):
    chips = tuple(Chip(n, str(n), (400.0, 300.0), (200.5, 150.5)) for n in (2, 5))
    model = DistortionModel(3, chips, "pix")
    rng = np.random.default_rng(3)
    theta = 0.1 * rng.normal(size=model.n_params)
    for chip in (2, 5):
        for axis in (0, 1):
            theta[model.coefficient_slice(chip, axis)][1 + axis] = (200.0, 150.0)[axis]
    found = calibration_of(StandIn(model, theta, some_covariance(theta.size, 1e-3, rng)), "made up")
    write(tmp_path, found)
    back = registry.read_calibration(tmp_path / "ast_5.txt")
    assert back.numbers == (5,) and back.unit == "pix"
    x, y = random_pixels((400.0, 300.0), 500)
    assert_allclose(back.forward(x, y, chip=5), found.forward(x, y, chip=5), atol=1e-9)
    theirs = found.joint_covariance((5,), origin="stated")
    assert_allclose(back.joint_covariance((5,), origin="stated"), theirs, atol=0)


def test_chains_of_linear_mappings_and_polynomials_are_read(tmp_path, ast):
    """As Rubin has them: pixels to -1 .. 1, the detector's polynomial, that of the visit."""
    rng = np.random.default_rng(5)
    device = [[c, k, i, j] for k in (1, 2) for c, i, j in
              ((0.1 * k, 0, 0), (0.03 * (k == 1), 1, 0), (0.03 * (k == 2), 0, 1),
               (rng.normal() * 1e-5, 2, 0), (rng.normal() * 1e-5, 1, 2))]  # fmt: skip
    visit = [[0.01, 1, 0, 0], [1.001, 1, 1, 0], [1e-3, 1, 2, 0], [0.02, 2, 0, 0], [0.999, 2, 0, 1]]
    norm = [[-1.0, 1, 0, 0], [2 / 4000, 1, 1, 0], [-1.0, 2, 0, 0], [2 / 4000, 2, 0, 1]]
    options = "IterInverse=1,NIterInverse=10,TolInverse=1e-7"
    maps = [ast.PolyMap(rows, None, options) for rows in (norm, device, visit)]
    maps += [ast.MatrixMap([[1.0, 0.1], [-0.1, 1.0]]), ast.ShiftMap([1.0, 2.0]), ast.ZoomMap(2, 3)]
    maps += [ast.MatrixMap([1.0, 2.0]), ast.UnitMap(2), ast.WinMap([0, 0], [1, 1], [1, 1], [3, 2])]
    chain = maps[0]
    for one in maps[1:]:
        chain = ast.CmpMap(chain, one, True)
    path = tmp_path / "chain.txt"
    path.write_text(dumped(ast, chain))
    found = registry.read_calibration(path, size=(4000.0, 4000.0))
    assert found.model.order == 6
    x, y = random_pixels((4000.0, 4000.0), 1000)
    theirs = 3600 * chain.tran([x - 1, y - 1], True).T
    pixel = np.sqrt(abs(np.linalg.det(found.chip(1).linear)))
    assert np.abs(found.forward(x, y, chip=1) - theirs).max() / pixel < 1e-6
    assert "iterative inverse, 10 steps" in registry.describe(path)


def _exchanged(text: str) -> str:
    """Powers of the two inputs exchanged in the second output, for the linear terms."""
    lines = text.splitlines(True)
    numbers = [k for k, line in enumerate(lines) if line.strip().startswith("PF")]
    half = sum(line.strip().startswith("CF") for line in lines) // 2
    names = {line.split("=")[0].strip(): k for k, line in enumerate(lines) if "PF" in line}
    a, b = names[f"PF{2 * half + 3}"], names[f"PF{2 * half + 6}"]
    assert a in numbers and b in numbers
    lines[a] = lines[a].replace(f"PF{2 * half + 3}", f"PF{2 * half + 4}")
    lines[b] = lines[b].replace(f"PF{2 * half + 6}", f"PF{2 * half + 5}")
    return "".join(lines)


def _in_arcsec(text: str) -> str:
    out = []
    for line in text.splitlines(True):
        name, _, value = line.partition("=")
        wanted = name.strip().startswith("CF")
        out.append(f"{name}= {3600 * float(value)!r}\n" if wanted else line)
    return "".join(out)


FAULTS = {
    "IterInverse": (lambda t: t.replace("IterInv = 1", "IterInv = 0"), "IterInv", "back to pixels"),
    "order of coefficients": (_exchanged, "PF", "exchanged in one output"),
    "arcsec": (_in_arcsec, "CF", "outputs are in degrees"),
    "no covariance": (
        lambda t: t.replace("ast_parameters", "other"), "parameters", "is missing"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_found(tmp_path, fault):
    change, where, message = FAULTS[fault]
    path = write(tmp_path, calibration_of(some_solution(3, unit="arcsec", pixel=PIXEL)))
    right = path.read_text()
    path.write_text(change(right))
    assert path.read_text() != right
    found = [f for f in registry.lint(path) if f.where == where and message in f.message]
    assert len(found) == 1 and registry.describe(path)


def test_a_mirror_image_is_noted(tmp_path):
    """The sign of one output: where the plane is on the sky, east is on the left of north."""
    right = write(tmp_path, on_sky(3))
    assert not registry.lint(right)
    text = right.read_text()
    half = text.count(" CF") // 2
    turned = re.sub(
        r" CF(\d+) = (\S+)",
        lambda f: f" CF{f[1]} = {float(f[2]) * (-1 if int(f[1]) > half else 1)!r}", text,
    )  # fmt: skip
    right.write_text(turned)
    found = [f for f in registry.lint(right) if f.where == "CF"]
    assert "parity of a mirror image" in found[0].message


def test_bad_dumps_get_a_sentence(tmp_path, ast):
    path = write(tmp_path, on_sky(3))
    right = path.read_text()
    for change, message in (
        (lambda t: t[: len(t) // 2], "does not end|not a line of a dump"),
        (lambda t: t.replace("End PolyMap", "End ZoomMap"), "ends a ZoomMap but not the PolyMap"),
        (lambda t: t.replace("CF3 =", "CX3 ="), "CF3 of the PolyMap is missing"),
        (lambda t: t.replace("NCF1 = 10", "NCF1 = many"), "not a number"),
        (lambda t: t.replace("Begin WinMap", "Begin PcdMap").replace("End WinMap", "End PcdMap"),
         "has a PcdMap, which is not a polynomial"),
        (lambda t: t.replace("PF3 = 1", "PF3 = 13"), "order 13"),
        (lambda t: t.replace("size 1200.0 900.0", "size large"), "give two numbers"),
    ):  # fmt: skip
        path.write_text(change(right))
        assert path.read_text() != right, message
        with pytest.raises((FormatError, InputError), match=message):
            registry.read_calibration(path)
    path.write_text(dumped(ast, ast.CmpMap(*[ast.PolyMap([[1.0, 1, 4, 0], [1.0, 2, 0, 1]], None,
                                                         "IterInverse=1")] * 2, True)))  # fmt: skip
    with pytest.raises(InputError, match="polynomial of order 16"):
        registry.read_calibration(path, size=SIZE)


def test_a_changed_mapping_does_not_take_the_errors_beside_it(tmp_path):
    path = write(tmp_path, on_sky(3))
    text = path.read_text()
    [line] = [line for line in text.splitlines() if line.strip().startswith("CF4 ")]
    value = float(line.split("=")[1])
    path.write_text(text.replace(line, f"CF4 = {1.01 * value!r}"))
    with pytest.raises(FormatError, match="one was changed"):
        registry.read_calibration(path)


def test_commands_take_mappings(tmp_path):
    path = write(tmp_path, on_sky(3))
    assert "covariance in ast_parameters.fits" in good("inspect", path).out
    (tmp_path / "stars.csv").write_text("x,y\n600,400\n10,890\n")
    good("apply", path, tmp_path / "stars.csv", "-o", tmp_path / "out.csv")
    assert "sigma_x_out" in (tmp_path / "out.csv").read_text()
    assert good("compare", path, path).out


# -- gbdes ----------------------------------------------------------------------------------------


def gbdes_table(seed: int = 1) -> tuple[Table, np.ndarray, np.ndarray]:
    """Table of two detectors of order 2 and a visit, their parameters and covariance."""
    rng = np.random.default_rng(seed)
    maps = {"r/3/poly": 2, "r/7/poly": 2, "101/poly": 1}
    rows, values = [], []
    for name, order in maps.items():
        half = (order + 1) * (order + 2) // 2
        linear = {1: (0.1, 0.0), 2: (0.002, 0.1)}
        for axis, coordinate in enumerate("xy"):
            for n in range(half):
                value = rng.normal() * 1e-4
                if n in linear:
                    value += (0.1, -0.002)[n - 1] if axis == 0 else linear[n][1]
                rows.append((name, coordinate, n))
                values.append(value)
    root = rng.normal(size=(len(rows), len(rows))) * 1e-7
    cov = root @ root.T
    table = Table(rows=rows, names=("mapName", "coordinate", "coefficientNumber"))
    table["parameter"] = values
    i = 0
    for name, order in maps.items():
        half = (order + 1) * (order + 2) // 2
        for p in range(2 * half):
            table[f"{name}_{'x' if p < half else 'y'}_{p}_cov"] = cov[i]
            i += 1
    return table, np.array(values), cov


@pytest.mark.parametrize("name", ["params.parquet", "params.ecsv"])
def test_parameters_of_gbdes_are_read_with_their_covariance(tmp_path, name):
    """Positions, and variances by the derivatives of gbdes's own polynomials."""
    table, values, cov = gbdes_table()
    path = tmp_path / name
    table.write(path)
    found = registry.read_calibration(path, size=(4000.0, 4072.0))
    assert found.numbers == (3, 7) and found.unit == "deg" and found.errors == "covariance"
    x, y = random_pixels((4000.0, 4072.0), 50)
    X, Y = 2 * (x - 1) / 4000 - 1, 2 * (y - 1) / 4072 - 1
    powers = np.stack([np.ones_like(X), X, Y, X**2, X * Y, Y**2])
    for k, number in enumerate((3, 7)):
        own = slice(12 * k, 12 * (k + 1))
        theirs = (values[own].reshape(2, 6) @ powers).T
        assert_allclose(found.forward(x, y, chip=number), theirs, atol=1e-14)
        block = cov[own, own].reshape(2, 6, 2, 6)
        expected = np.einsum("kn,akbl,ln->nab", powers, block, powers)
        got = found.chip(number, origin="stated").covariance_at(x, y)
        assert_allclose(got, expected, rtol=1e-9, atol=1e-22)
    joint = found.joint_covariance((3, 7), origin="stated")
    assert np.abs(joint[:12, 12:]).max() > 0.01 * np.abs(joint).max()
    assert not registry.lint(path) and "3 maps" in registry.describe(path)


GBDES_FAULTS = {
    "covariance missing": (lambda t: t.remove_column("r/7/poly_y_9_cov"), "are missing"),
    "not symmetric": (
        lambda t: t["r/3/poly_x_0_cov"].__setitem__(5, 1e-9), "not symmetric"),
    "order": (lambda t: t["coefficientNumber"].__setitem__(1, 2), "not in the order"),
    "exchanged": (
        lambda t: t["parameter"].__setitem__([7, 8], [t["parameter"][8], t["parameter"][7]]),
        "not perpendicular"),
    "arcsec": (lambda t: t.replace_column("parameter", 3600 * t["parameter"]), "is the degree"),
    "parity": (
        lambda t: t["parameter"].__setitem__(slice(6, 12), -t["parameter"][6:12]),
        "of different parity"),
}  # fmt: skip


@pytest.mark.parametrize("fault", GBDES_FAULTS)
def test_planted_faults_of_gbdes_are_found(tmp_path, fault):
    change, message = GBDES_FAULTS[fault]
    table, *_ = gbdes_table()
    change(table)
    path = tmp_path / "wrong.ecsv"
    table.write(path)
    assert [f for f in registry.lint(path) if message in f.message]


@pytest.mark.parametrize(
    ("column", "message"),
    [("parameter", "not finite"), ("r/3/poly_x_0_cov", "missing or not finite"),
     ("coefficientNumber", "not in the order"), ("coordinate", "not in the order")],
)  # fmt: skip
def test_missing_values_of_gbdes_are_not_read_as_zero(tmp_path, column, message):
    table, *_ = gbdes_table()
    table = Table(table, masked=True)
    table[column].mask[0] = True
    table.write(tmp_path / "masked.ecsv")
    with pytest.raises(InputError, match=message):
        registry.read_calibration(tmp_path / "masked.ecsv", size=(4000.0, 4072.0))


def test_gbdes_needs_a_size_and_a_band(tmp_path):
    table, *_ = gbdes_table()
    path = tmp_path / "params.ecsv"
    table.write(path)
    with pytest.raises(InputError, match="the size of the detectors"):
        registry.read_calibration(path)
    with pytest.raises(InputError, match="no band i"):
        registry.read_calibration(path, filter="i", size=(10.0, 10.0))
    (tmp_path / "stars.csv").write_text("x,y,chip\n600,400,3\n10,890,7\n")
    good("apply", path, tmp_path / "stars.csv", "-o", tmp_path / "o.csv", "--size", 4000, 4072)
