"""An opened graphics card: buffers, programs of WGSL shaders, and what is recorded for it to do.

The card is reached through wgpu (Vulkan, Metal, DirectX 12), which is installed only where it is wanted.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import GpuError
from .adapters import Adapter

SHADERS = Path(__file__).with_name("wgsl")
WORKGROUP = 256
CLOCK = "timestamp-query"
MOST_STAGES = 64
"""Parts of a recording that a clock can time."""
ACROSS = 32768
"""Workgroups in a row of a dispatch; more go into further rows, since a dimension has at most 65,535."""
_BINDING = re.compile(r"@binding\((\d+)\)\s+var<storage,\s*(read|read_write)>\s+(\w+)")
_ENTRY = re.compile(r"@compute.*?\nfn (\w+)", re.DOTALL)


@dataclass(frozen=True, eq=False)
class Program:
    """A compiled module. places: of each buffer's name its binding; pipelines: by entry point."""

    places: Mapping[str, int]
    layout: Any
    pipelines: Mapping[str, Any]


@dataclass(eq=False)
class Card:
    """The device of an adapter. Buffers have names and are reused, or replaced when more is needed."""

    adapter: Adapter
    device: Any
    timed: bool = False
    buffers: dict[str, Any] = field(default_factory=dict)
    _programs: dict[tuple[str, ...], Program] = field(default_factory=dict)
    _bound: dict[tuple[int, ...], Any] = field(default_factory=dict)

    @classmethod
    def open(cls, adapter: Adapter, *, timed: bool = False) -> Card:
        """Open an adapter's device. timed: with a clock for the stages of what is recorded, if the card has one.

        Raises:
            GpuError: it lacks what the kernels need, or its driver refuses.
        """
        timed = timed and CLOCK in adapter.handle.features
        return cls(adapter, adapter.request([CLOCK] if timed else []), timed)

    @property
    def bytes(self) -> int:
        """Of all buffers."""
        return sum(held.size for held in self.buffers.values())

    @cached_property
    def _wgpu(self) -> Any:
        import wgpu

        return wgpu

    def buffer(self, name: str, values: int) -> Any:
        """The buffer of a name with room for at least this many 32-bit values; its contents are lost if it grows.

        Raises:
            GpuError: the card's memory, or the largest buffer that it allows, does not suffice.
        """
        held, size = self.buffers.get(name), 4 * max(values, 4)
        if held is not None and held.size >= size:
            return held
        if size > self.adapter.largest_buffer:
            raise GpuError(
                f"{self.adapter.name} holds buffers of at most {self.adapter.largest_buffer / 2**20:.0f} MiB, and "
                f"{size / 2**20:.0f} MiB are needed. Train with fewer Gaussians or smaller photos, or with "
                "--train.device cpu"
            )
        if held is not None:
            self._bound.clear()
            held.destroy()
        usage = self._wgpu.BufferUsage
        kinds = usage.STORAGE | usage.COPY_SRC | usage.COPY_DST | usage.INDIRECT
        self.buffers[name] = self._checked(lambda: self.device.create_buffer(size=size, usage=kinds))
        return self.buffers[name]

    def upload(self, name: str, values: NDArray[Any]) -> Any:
        """A buffer of 32-bit values with this content."""
        found = self.buffer(name, values.size)
        self._checked(lambda: self.device.queue.write_buffer(found, 0, np.ascontiguousarray(values)))
        return found

    def download(self, name: str, kind: type, values: int, offset: int = 0) -> NDArray[Any]:
        """The first 32-bit values of a buffer, after all work that was submitted.

        Raises:
            GpuError: the card was lost.
        """
        found = self.buffers[name]
        read = self._checked(lambda: self.device.queue.read_buffer(found, 4 * offset, 4 * values))
        return np.frombuffer(read, kind, values)

    def drop(self, name: str) -> None:
        """Free the memory of a buffer."""
        self._bound.clear()
        self.buffers.pop(name).destroy()

    def program(self, *files: str, **constants: float) -> Program:
        """The module of these files of `wgsl`, one after another, with constants of type f32."""
        lines = tuple(f"const {name}: f32 = {float(value)!r};" for name, value in constants.items())
        if (key := (*lines, *files)) not in self._programs:
            code = "\n".join([*lines, *map(_source, files)])
            self._programs[key] = self._checked(lambda: self._compiled(code))
        return self._programs[key]

    def _compiled(self, code: str) -> Program:
        found = [(int(place), access, name) for place, access, name in _BINDING.findall(code)]
        kinds = {"read": "read-only-storage", "read_write": "storage"}
        visible = self._wgpu.ShaderStage.COMPUTE
        layout = self.device.create_bind_group_layout(
            entries=[
                {"binding": place, "visibility": visible, "buffer": {"type": kinds[access]}}
                for place, access, _ in found
            ]
        )
        whole = self.device.create_pipeline_layout(bind_group_layouts=[layout])
        module = self.device.create_shader_module(code=code)
        pipelines = {
            entry: self.device.create_compute_pipeline(layout=whole, compute={"module": module, "entry_point": entry})
            for entry in _ENTRY.findall(code)
        }
        return Program({name: place for place, _, name in found}, layout, pipelines)

    def bind(self, program: Program, buffers: Mapping[str, Any]) -> Any:
        """The bind group of a program with its buffers by name."""
        own = {name: buffers[name] for name in program.places}
        key = (id(program), *(id(each) for each in own.values()))
        if key not in self._bound:
            entries = [
                {"binding": program.places[name], "resource": {"buffer": held, "offset": 0, "size": held.size}}
                for name, held in own.items()
            ]
            self._bound[key] = self.device.create_bind_group(layout=program.layout, entries=entries)
        return self._bound[key]

    def record(self) -> Recording:
        """Begin what the card shall do next."""
        return Recording(self, self.device.create_command_encoder())

    @cached_property
    def clock(self) -> tuple[Any, Any]:
        """Where a card with a clock stores times, and the buffer that they are read from."""
        usage = self._wgpu.BufferUsage
        times = self.device.create_query_set(type="timestamp", count=2 * MOST_STAGES)
        kinds = usage.QUERY_RESOLVE | usage.COPY_SRC
        return times, self.device.create_buffer(size=16 * MOST_STAGES, usage=kinds)

    def submit(self, encoder: Any) -> None:
        """Hand over what was recorded.

        Raises:
            GpuError: the card was lost.
        """
        self._checked(lambda: self.device.queue.submit([encoder.finish()]))

    def _checked(self, work: Any) -> Any:
        """The result of a call of the driver.

        Raises:
            GpuError: the driver failed.
        """
        try:
            return work()
        except (self._wgpu.GPUError, RuntimeError, MemoryError) as error:
            reason = str(error).strip().splitlines()
            raise GpuError(f"{self.adapter.name} failed: {reason[-1] if reason else type(error).__name__}") from error


class Recording:
    """A list of dispatches, handed to the card together."""

    def __init__(self, card: Card, encoder: Any) -> None:
        self._card, self._encoder = card, encoder
        self._stages: list[str] = []
        self._pass: Any = None
        self.stage("")

    def stage(self, name: str) -> None:
        """What follows belongs to the stage of this name; only a card with a clock takes note."""
        if self._pass is not None and not self._card.timed:
            return
        if self._pass is not None:
            self._pass.end()
        self._stages.append(name)
        self._pass = self._begun()

    def _begun(self) -> Any:
        if not self._card.timed:
            return self._encoder.begin_compute_pass()
        place = 2 * (len(self._stages) - 1)
        written = {
            "query_set": self._card.clock[0],
            "beginning_of_pass_write_index": place,
            "end_of_pass_write_index": place + 1,
        }
        return self._encoder.begin_compute_pass(timestamp_writes=written)

    def run(self, program: Program, entry: str, buffers: Mapping[str, Any], *groups: int) -> None:
        """Dispatch an entry point with this many workgroups (x, y, z)."""
        self._set(program, entry, buffers)
        self._pass.dispatch_workgroups(*groups)

    def run_for(self, program: Program, entry: str, buffers: Mapping[str, Any], invocations: int) -> None:
        """Dispatch an entry point with at least this many invocations, in rows of `ACROSS` workgroups."""
        groups = -(-max(invocations, 1) // WORKGROUP)
        across = min(groups, ACROSS)
        self.run(program, entry, buffers, across, -(-groups // across), 1)

    def run_planned(self, program: Program, entry: str, buffers: Mapping[str, Any], plan: Any, place: int) -> None:
        """Dispatch an entry point with the numbers of workgroups that lie at a 32-bit place of `plan`."""
        self._set(program, entry, buffers)
        self._pass.dispatch_workgroups_indirect(plan, 4 * place)

    def clear(self, buffer: Any) -> None:
        """Fill a buffer with 0."""
        self._pass.end()
        self._encoder.clear_buffer(buffer)
        self._stages.append(self._stages[-1])
        self._pass = self._begun()

    def submit(self) -> None:
        self._pass.end()
        if self._card.timed:
            times, buffer = self._card.clock
            self._encoder.resolve_query_set(times, 0, 2 * len(self._stages), buffer, 0)
        self._card.submit(self._encoder)

    def shares(self) -> dict[str, float]:
        """Of the card's time for what was submitted: the share of each stage; empty without a clock."""
        if not self._card.timed:
            return {}
        read = self._card.device.queue.read_buffer(self._card.clock[1], 0, 16 * len(self._stages))
        spans = np.frombuffer(read, np.uint64).reshape(-1, 2).astype(np.float64)
        taken: dict[str, float] = {}
        for name, (begin, end) in zip(self._stages, spans, strict=True):
            taken[name] = taken.get(name, 0.0) + max(end - begin, 0.0)
        whole = sum(taken.values())
        return {name: each / whole for name, each in taken.items() if name} if whole > 0.0 else {}

    def _set(self, program: Program, entry: str, buffers: Mapping[str, Any]) -> None:
        self._pass.set_pipeline(program.pipelines[entry])
        self._pass.set_bind_group(0, self._card.bind(program, buffers))


@cache
def _source(name: str) -> str:
    return (SHADERS / f"{name}.wgsl").read_text(encoding="utf-8")
