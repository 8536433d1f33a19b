"""Public names and the modules that define them; each is imported on first use."""

from .pairs.read import read_rvb as read_rvb
from .plugin import PLUGIN as PLUGIN
from .simulate import (
    simulate_wise as simulate_wise,
    simulate_wise_partitioned as simulate_wise_partitioned,
    wise_solution as wise_solution,
)
