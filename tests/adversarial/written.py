"""Configurations as a user writes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def toml_text(config: Mapping[str, Any]) -> str:
    """A configuration of blocks, and of lists of blocks, as TOML."""
    lines: list[str] = []
    for name, block in config.items():
        for one in block if isinstance(block, list) else [block]:
            lines.append(f"[[{name}]]" if isinstance(block, list) else f"[{name}]")
            inner = {k: v for k, v in one.items() if isinstance(v, dict)}
            lines += [f"{k} = {json.dumps(v)}" for k, v in one.items() if k not in inner]
            lines += [toml_text({f"{name}.{k}": v}) for k, v in inner.items()]
    return "\n".join(lines)
