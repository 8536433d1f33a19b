"""Small runs of each kind, which take a few seconds."""

from __future__ import annotations

from pathlib import Path

from tests.app.support import edit, good
from tests.kinds.selfcal.runs.support import list_table, small, write_selfcal

CONFIG = """
[data]
matches = "stars.ecsv"

[detector]
size = [1016, 1016]

[model]
order = 3

[sampler]
seed = 3
ensembles = 2
target_ess = 1e9                # never reached: the run ends at max_steps
max_steps = 100
checkpoint_every = 25

[assess]
grid = [5, 5]
draws = 100

[products]
sip = {}
"""


def _matches(folder: Path) -> Path:
    """Matched stars; the sampler continues to its last step and writes many checkpoints."""
    good("simulate", "wise", "-o", folder, "--stars", 500, "-q")
    config = folder / "config.toml"
    config.write_text(CONFIG, encoding="utf-8")
    return config


def _campaign(folder: Path) -> Path:
    """Star lists of a few exposures, look-up tables and a drift; no requirement, no release."""
    good("simulate", "acs", "-o", folder, "--exposures", 6, "--stars", 2000, "--seed", 3, "-q")
    config = edit(
        folder / "campaign_f606w.toml",
        {
            'method = "field"': 'step = [512.0, 512.0]\nmethod = "field"',
            "[assess]": "[sampler]\nensembles = 2\ntarget_ess = 50\ntarget_rhat = 1.2\n\n[assess]",
            "grid = [33, 17]": "grid = [5, 3]\ndraws = 100\nyears_ahead = 0",
            "order = 5": "order = 3",
        },
    )
    text = config.read_text(encoding="utf-8")
    config.write_text(text.partition("[products.release]")[0], encoding="utf-8")
    return config


def _selfcal(folder: Path) -> Path:
    """Dithered exposures without a catalogue."""
    settings = {
        "sampler": {"target_ess": 100, "ensembles": 2},
        "assess": {"grid": (5, 5), "draws": 100},
    }
    return write_selfcal(folder, list_table(small()), products={"sip": {}}, **settings)


# functions that write the input of a run into a folder and return its configuration
JOBS = {"matches": _matches, "campaign": _campaign, "selfcal": _selfcal}
