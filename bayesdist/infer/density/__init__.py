"""The posterior density and its approximations."""
