"""Devices by name, and arrays on them."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import _core
from .errors import UsageError


def ordinal_of(device: str) -> int:
    """Number of a CUDA device: 0 of "cuda", N of "cuda:N", -1 of "cpu"."""
    if device == "cpu":
        return -1
    if device == "cuda":
        return 0
    number = str(device)[5:]
    if str(device).startswith("cuda:") and number.isdecimal() and len(number) < 10:
        return int(number)
    raise UsageError(f"device {device!r}: expected cpu, cuda or cuda:N", code="usage.value.devices")


def to_device(array: np.ndarray[Any, Any], device: str = "cuda") -> _core.DeviceArray:
    """A copy of an array of any shape, such as [N, 3], in the memory of a CUDA device: "cuda" or "cuda:N".

    Raises:
        UnavailableError: there is no such device.
    """
    ordinal = ordinal_of(device)
    if ordinal < 0:
        raise UsageError("to_device: an array in the memory of the CPU is the array itself; name cuda or cuda:N",
                         code="python.device.host")
    return _core.to_device(np.asarray(array), ordinal)
