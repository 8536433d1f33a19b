"""ACS of the Hubble Space Telescope: a simulated campaign, and what its handbook shows."""

from bayesdist.mission import Mission

__all__ = ["MISSION"]

_COMMANDS = "bayesdist.missions.acs.commands"

MISSION = Mission(
    title="HST: what its handbooks show of a calibration.",
    commands={"handbook": f"{_COMMANDS}:handbook", "pam": f"{_COMMANDS}:pam"},
    simulate={"acs": f"{_COMMANDS}:simulate"},
)
