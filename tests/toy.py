"""A small file format: an example for tests of the core, and a plugin of its own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from bayesdist import plugin
from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.errors import FormatError
from bayesdist.plugin import GROUP, SELECTION, Plugin
from bayesdist.products import registry
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    FormatSettings,
)


@dataclass(frozen=True)
class Toy:
    """A scale and a bend, as JSON."""

    scale: float
    bend: float


class ToySettings(FormatSettings):
    digits: int = 17


def parse(content: Content) -> Toy | None:
    if not content.text.startswith('{"toy"'):
        return None
    try:
        return Toy(**json.loads(content.text)["toy"])
    except (TypeError, ValueError) as error:
        raise FormatError(f"is no toy ({error})", where=content.name, do="mend it") from error


def lint(toy: Toy) -> list[Finding]:
    return [Finding("warning", "scale", "is negative")] if toy.scale < 0 else []


def calibration(toy: Toy, name: str, choice: Choice) -> Calibration:
    def positions(x, y):
        dx, dy = x - 500.0, y - 400.0
        return toy.scale * (dx + toy.bend * dx**2), toy.scale * dy

    chip_map = fitted_map(
        positions, name, order=2, size=choice.size or (1000.0, 800.0),
        reference_pixel=(500.0, 400.0), unit="arcsec", chip=1,
    )  # fmt: skip
    return calibration_of_maps({1: chip_map}, name)


def build(made: Calibration, settings: ToySettings, options: BuildOptions) -> tuple[Built, ...]:
    values = made.chip(origin="stated").monomials().values
    toy = {"scale": values[1, 2], "bend": values[0, 3] / values[0, 1]}
    text = json.dumps({"toy": {k: round(float(v), settings.digits) for k, v in toy.items()}})
    return (Built("toy.json", "toy", text.encode(), toy),)


FORMAT = Format(
    "toy", "a toy", 9, parse, lambda toy: [f"toy of scale {toy.scale:g}"], lint, calibration,
    ToySettings, build,
)  # fmt: skip
PLUGIN = Plugin(formats={"toy": "tests.toy:FORMAT"})


def install(folder: Path, name: str, target: str) -> None:
    """Write what an installer leaves of a package with one entry point for plugins."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {target}\n")


@contextmanager
def toy_installed(folder: Path) -> Iterator[None]:
    """The toy is one of the formats of this process, and the only one if all others are hidden."""
    install(folder, "toy", "tests.toy:PLUGIN")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        selected = plugin.os.environ.get(SELECTION)
        if selected is not None:
            patch.setenv(SELECTION, f"{selected},toy")
        forget()
        yield
    forget()


def forget() -> None:
    """Plugins are looked for again."""
    plugin.plugins.cache_clear()
    registry.all_formats.cache_clear()
