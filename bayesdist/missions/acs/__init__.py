"""ACS of the Hubble Space Telescope: a simulated campaign, and what its handbook shows."""
