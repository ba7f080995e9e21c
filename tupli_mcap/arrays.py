"""What arrays are called in annotations."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["Array", "DType"]

Array = np.ndarray[Any, Any]
DType = np.dtype[Any]
