"""Width of the vectors that the passes are compiled for.

LLVM takes half the width of the vectors of AVX-512, lest a program that uses them now and then
slows the processor down.  The passes are nothing but vectors, and a third faster with all of it.
"""

from __future__ import annotations

from typing import Any

from numba import config, types
from numba.extending import intrinsic

from bayesdist.infer.kernel.lanes import HAS_512

WHOLE = HAS_512 and config.CPU_FEATURES is None  # the user's own choice comes first


@intrinsic
def whole_vectors(typingctx: Any) -> Any:
    """Compile the function that calls this for vectors of the whole width.

    An attribute of one function: numba's configuration, and with it the code of all other
    functions of the process and the names of their caches, stays as it is.
    """

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        if WHOLE:
            # llvmlite writes attributes out as they are, but its `add` refuses those with a value
            set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), build
