"""SIMD vector width for which the passes are compiled.

By default LLVM uses half the vector width of AVX-512, because occasional use of full vectors can
reduce the clock rate.  The passes consist of vector code and are a third faster with full width.
"""

from __future__ import annotations

from typing import Any

from numba import config, types
from numba.extending import intrinsic

from bayesdist.infer.kernel.lanes import HAS_512

WHOLE = HAS_512 and config.CPU_FEATURES is None  # a choice by the user takes precedence


@intrinsic
def whole_vectors(typingctx: Any) -> Any:
    """Compile the calling function for the full vector width.

    This sets an attribute of that function only.  The configuration of numba, and with it the
    code and cache of all other functions in the process, is unchanged.
    """

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        if WHOLE:
            # bypasses the `add` of llvmlite, which refuses attributes with a value
            set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), build
