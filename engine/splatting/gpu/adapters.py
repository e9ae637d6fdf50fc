"""The graphics cards of this machine, and the choice of one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

from ...errors import GpuError

LIMITS = {
    "max-storage-buffers-per-shader-stage": 13,
    "max-compute-workgroup-storage-size": 24 << 10,
    "max-compute-invocations-per-workgroup": 256,
    "max-compute-workgroup-size-x": 256,
}
"""What the kernels need at least."""
GREEDY = ("max-buffer-size", "max-storage-buffer-binding-size")
"""Limits of which a card is asked for all that it has."""
BUDGET = 90
"""Per cent of the card's memory above which a new buffer is refused."""
INSTALL = "Install it with: pip install wgpu"


@dataclass(frozen=True, eq=False)
class Adapter:
    """A way to a graphics card. name: of the card; driver: its version; backend: Vulkan, Metal or D3D12; software:
    whether a program plays the card."""

    name: str
    driver: str
    backend: str
    software: bool
    handle: Any

    @property
    def largest_buffer(self) -> int:
        """Bytes."""
        return min(int(self.handle.limits[name]) for name in GREEDY)

    @property
    def missing(self) -> list[str]:
        """Limits that are too low for the kernels, as texts."""
        limits = self.handle.limits
        return [f"{name} is {limits[name]}, {need} are needed" for name, need in LIMITS.items() if limits[name] < need]

    @property
    def identity(self) -> str:
        """Card, backend and driver: equal identities compute equal bytes."""
        return f"{self.name} ({self.backend}, {self.driver})"

    def require_limits(self) -> None:
        """Raises GpuError if it lacks what the kernels need."""
        if self.missing:
            raise GpuError(f"{self.name} cannot be used: {self.missing[0]}. Train with --train.device cpu")

    def request(self, features: Sequence[str] = ()) -> Any:
        """Open the device. features: further features of WebGPU that it needs.

        Raises:
            GpuError: it lacks what the kernels need, or its driver refuses.
        """
        self.require_limits()
        wanted = {**LIMITS, **{name: int(self.handle.limits[name]) for name in GREEDY}}
        try:
            return self.handle.request_device_sync(required_limits=wanted, required_features=list(features))
        except Exception as error:  # wgpu raises errors of the driver as they come
            raise GpuError(f"{self.name} cannot be opened ({error}). Train with --train.device cpu") from error


def find_adapters() -> list[Adapter]:
    """All adapters, real cards first, in the order of the drivers.

    Raises:
        GpuError: wgpu is not installed, or finds no driver library.
    """
    try:
        import wgpu
    except ImportError as error:
        raise GpuError(f"The package wgpu, which reaches graphics cards, is missing. {INSTALL}") from error
    try:
        handles = _list_adapters(wgpu)
    except Exception as error:
        raise GpuError(f"Graphics cards cannot be listed ({error}). Install the driver of the card") from error
    return sorted(map(_adapter, handles), key=lambda each: each.software)


@cache
def _list_adapters(wgpu: Any) -> list[Any]:
    """List the drivers' adapters, without OpenGL, which has no compute shaders everywhere."""
    from wgpu.backends.wgpu_native.extras import set_instance_extras

    # This layer of Mesa only sorts the cards; without a desktop it prints errors to the terminal.
    os.environ.setdefault("NODEVICE_SELECT", "1")
    with suppress(RuntimeError):  # another package made the instance already
        set_instance_extras(backends=["Vulkan", "Metal", "DX12"], budget_for_device_creation=BUDGET)
    handles: list[Any] = wgpu.gpu.enumerate_adapters_sync()
    return [handle for handle in handles if handle.info["backend_type"] != "OpenGL"]


def _adapter(handle: Any) -> Adapter:
    info = handle.info
    driver = info["description"] or f"{info['vendor_id']:x}:{info['device_id']:x}"
    return Adapter(info["device"], driver, info["backend_type"], info["adapter_type"] == "CPU", handle)


def choose_adapter(wanted: str) -> Adapter | None:
    """The adapter for a setting: "cpu" is none; "auto" a real card that has what the kernels need, or none; "gpu" such
    a card; any other text the adapter whose name contains it, software too.

    Raises:
        GpuError: what was asked for is not there; it says what was found.
    """
    if wanted == "cpu":
        return None
    try:
        found = find_adapters()
    except GpuError:
        if wanted == "auto":
            return None
        raise
    if wanted in ("auto", "gpu"):
        fit = [each for each in found if not each.software and not each.missing]
    else:
        fit = [each for each in found if wanted.casefold() in each.name.casefold()]
    if fit:
        fit[0].require_limits()
        return fit[0]
    if wanted == "auto":
        return None
    listed = "; ".join(
        f"{each.name} ({'software, ' if each.software else ''}{each.missing[0] if each.missing else each.backend})"
        for each in found
    )
    asked = "No graphics card is found" if wanted == "gpu" else f"No graphics card is named '{wanted}'"
    advice = (
        "Train with --train.device cpu"
        if listed
        else "Install the driver of the card, or train with --train.device cpu"
    )
    raise GpuError(f"{asked}. Found: {listed or 'none'}. {advice}")
