"""Width of the vectors that the passes are compiled for.

LLVM takes half the width of the vectors of AVX-512, lest a program that uses them now and then
slows the processor down.  The passes are nothing but vectors, and a third faster with all of it.
"""

from __future__ import annotations

from numba import config
from numba.core.codegen import get_host_cpu_features


def use_whole_vectors() -> None:
    """Compile for the whole width, unless numba's variables for the processor say otherwise.

    Without effect in a process in which numba has already compiled something else.
    """
    features = get_host_cpu_features()
    wide = "+avx512f" in features.split(",")
    if wide and config.CPU_FEATURES is None and config.CPU_NAME is None:
        config.CPU_FEATURES = f"{features},-prefer-256-bit"
