"""Simulate a mask of pinholes that a stage moves, and write what calibrates the camera by it.

Nobody knows where the holes are; the steps and turns of the stage are known. The files are
mask/holes.ecsv, mask/stage.ecsv and mask/mask.toml, for `bayesdist check` and `bayesdist run`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.table import QTable

SIZE, HOLES, REACH, FOLDER = 1024, 800, 560.0, Path("mask")
STAGE, CENTROID = 0.002, 0.004  # pixels, 1 sigma of a step and of a centroid
# where the camera points on the mask: steps in pixels, turn in degrees from u to v
POSITIONS = [(0, 0, 0), (17, 5, 0), (-9, 21, 0), (30, -14, 0), (4, 8, 90), (-22, -11, 90)]

CONFIG = """\
# A mask of pinholes: a self-calibration whose offsets are known. The turn by 90 degrees fixes what
# steps alone leave open, the skew of the camera.
[selfcal]
lists = "holes.ecsv"
simulated = true
sigma = 0.004
match_radius = 1.0
start_radius = 6.0

[gauge]
offsets = "stage.ecsv"
offset_sigma = 0.002
roll_sigma_deg = 0.0005

[detector]
name = "imager"
size = [1024, 1024]

[model]
order = 7
"""


def distorted(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of positions in the focal plane: some pixels of third to seventh order."""
    X, Y = u / 512, v / 512
    r2 = X**2 + Y**2
    x = u + 2.0 * X * r2 + 0.5 * X * Y - 0.3 * X * r2**3
    y = v + 2.0 * Y * r2 - 0.4 * X**2 - 0.3 * Y * r2**3
    return x + (SIZE + 1) / 2, y + (SIZE + 1) / 2


def main() -> None:
    """Write the files."""
    rng = np.random.default_rng(1)
    holes = rng.uniform(-REACH, REACH, (2, HOLES))  # no grid: which hole is which shows by patterns
    found = []
    for k, (du, dv, turn) in enumerate(POSITIONS):
        du, dv = holes - rng.normal((du, dv), STAGE)[:, None]
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        x, y = distorted(c * du + s * dv, c * dv - s * du)
        x, y = (z + rng.normal(0, CENTROID, z.shape) for z in (x, y))
        inside = (np.minimum(x, y) > 1) & (np.maximum(x, y) < SIZE)
        found += [(f"p{k}", a, b) for a, b in zip(x[inside], y[inside], strict=True)]
    FOLDER.mkdir(exist_ok=True)
    QTable(rows=found, names=("exposure", "x", "y")).write(FOLDER / "holes.ecsv", overwrite=True)
    stage = QTable(rows=[(f"p{k}", *one) for k, one in enumerate(POSITIONS)],
                   names=("exposure", "du", "dv", "roll"))  # fmt: skip
    stage.write(FOLDER / "stage.ecsv", overwrite=True)
    (FOLDER / "mask.toml").write_text(CONFIG, encoding="utf-8")
    print(f"{FOLDER}: {len(found)} detections of holes; bayesdist check {FOLDER / 'mask.toml'}")


if __name__ == "__main__":
    main()
