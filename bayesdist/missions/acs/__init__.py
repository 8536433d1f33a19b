"""HST/ACS: a simulated campaign, published linear terms, and the figures of its handbook."""

from bayesdist.mission import Mission

__all__ = ["MISSION"]

_COMMANDS = "bayesdist.missions.acs.commands"

MISSION = Mission(
    title="HST: handbook figures and pixel area maps.",
    commands={"handbook": f"{_COMMANDS}:handbook", "pam": f"{_COMMANDS}:pam"},
    simulate={"acs": f"{_COMMANDS}:simulate"},
    report="bayesdist.missions.acs.published",
)
