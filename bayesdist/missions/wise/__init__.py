"""WISE: simulated pairs, the tables and figures of its distortion report, and its files."""

from bayesdist.mission import Mission

__all__ = ["MISSION"]

_COMMANDS = "bayesdist.missions.wise.commands"

MISSION = Mission(
    title="WISE: its bands beside each other, its pairs and its files.",
    commands={name: f"{_COMMANDS}:{name}" for name in ("bands", "rotate", "rvb")},
    simulate={"wise": f"{_COMMANDS}:simulate"},
    beside_core={"demo": f"{_COMMANDS}:demo"},
)
