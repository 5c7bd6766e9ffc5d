# SPDX-License-Identifier: Apache-2.0
"""JSON files: strict, and there whole or not at all."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ggwarp.io.atomic import atomic_write


def write_json(path: str | Path, value: Any) -> None:
    """Write ``value``; numbers that JSON has no word for become null.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_write(path) as file:
        file.write((json.dumps(_finite(value), indent=2) + "\n").encode())


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return value
