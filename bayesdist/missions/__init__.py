"""Missions: plug-ins for single instruments, which use the core like an external package."""
