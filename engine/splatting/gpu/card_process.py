"""The process that drives a graphics card: a driver that crashes, hangs or loses its device ends this process only.

`card.Card` starts it and writes messages to its standard input; messages that ask for something are answered on its
standard output. A message is its sizes (`FRAME`), a JSON list of an operation of `_Driver` and its arguments, and raw
bytes. An error of the driver is the answer to the next message that asks for something; nothing else is done after it.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
from collections.abc import Mapping, Sequence
from typing import IO, Any

from ...errors import GpuError
from .adapters import Adapter, find_adapters

FRAME = struct.Struct("<IQ")
"""Sizes of a message: bytes of the JSON text and of what follows it."""
RUN, RUN_PLANNED, CLEAR, STAGE = range(4)
"""Kinds of recorded commands."""
CLOCK = "timestamp-query"
MOST_PASSES = 64
"""Parts of a recording that a clock can time."""


def write_message(stream: IO[bytes], words: Sequence[Any], data: bytes | memoryview = b"") -> None:
    """Send a message."""
    text = json.dumps(words, separators=(",", ":")).encode()
    stream.write(FRAME.pack(len(text), len(data)) + text)
    if len(data):
        stream.write(data)
    stream.flush()


def read_message(stream: IO[bytes]) -> tuple[list[Any], bytearray]:
    """Receive a message.

    Raises:
        EOFError: the other side has ended.
    """
    text_size, data_size = FRAME.unpack(_read_exactly(stream, FRAME.size))
    words: list[Any] = json.loads(_read_exactly(stream, text_size))
    return words, _read_exactly(stream, data_size)


def _read_exactly(stream: IO[bytes], size: int) -> bytearray:
    found = bytearray(size)
    if stream.readinto(found) < size:  # type: ignore[attr-defined]
        raise EOFError
    return found


def main(arguments: Sequence[str]) -> None:
    """Open the adapter with an identity and serve until the parent ends. arguments: the identity, and "timed" for a
    clock, if the card has one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # after Ctrl-C the parent still fetches what was learnt
    # What drivers print must not come between the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    driver, failure = None, ""
    try:
        driver = _Driver(_adapter(arguments[0]), timed="timed" in arguments[1:])
        write_message(answers, ["", driver.timed])
    except Exception as error:  # wgpu raises errors of the driver as they come
        write_message(answers, [_reason(error)])
        return
    while True:
        try:
            (operation, *rest), data = read_message(sys.stdin.buffer)
        except EOFError:
            os._exit(0)  # without the driver's own end, which can hang
        asks = operation in ("read", "times")
        answer: bytes | memoryview = b""
        if not failure:
            try:
                answer = getattr(driver, operation)(*rest, *([data] if operation == "write" else []))
            except Exception as error:
                failure = _reason(error)
        if asks:
            write_message(answers, [failure], b"" if failure else answer)


def _adapter(identity: str) -> Adapter:
    found = [each for each in find_adapters() if each.identity == identity]
    if not found:
        raise GpuError("it is not found any more")
    return found[0]


def _reason(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1].strip() if lines else type(error).__name__


class _Driver:
    """An opened device and what was made on it, by the numbers that the parent gave."""

    def __init__(self, adapter: Adapter, *, timed: bool) -> None:
        import wgpu

        self.wgpu = wgpu
        self.timed = timed and CLOCK in adapter.handle.features
        self.device = adapter.request([CLOCK] if self.timed else [])
        self.buffers: dict[int, Any] = {}
        self.layouts: dict[int, Any] = {}
        self.pipelines: dict[tuple[int, str], Any] = {}
        self.groups: dict[int, tuple[Any, frozenset[int]]] = {}
        if self.timed:
            usage = wgpu.BufferUsage
            self.clock = self.device.create_query_set(type="timestamp", count=2 * MOST_PASSES)
            kinds = usage.QUERY_RESOLVE | usage.COPY_SRC
            self.clock_buffer = self.device.create_buffer(size=16 * MOST_PASSES, usage=kinds)

    def create(self, number: int, size: int) -> None:
        """A buffer of this many bytes."""
        usage = self.wgpu.BufferUsage
        kinds = usage.STORAGE | usage.COPY_SRC | usage.COPY_DST | usage.INDIRECT
        self.buffers[number] = self.device.create_buffer(size=size, usage=kinds)

    def destroy(self, number: int) -> None:
        self.groups = {group: found for group, found in self.groups.items() if number not in found[1]}
        self.buffers.pop(number).destroy()

    def write(self, number: int, data: bytearray) -> None:
        self.device.queue.write_buffer(self.buffers[number], 0, data)

    def read(self, number: int, offset: int, size: int) -> memoryview:
        """Bytes of a buffer, after all work that was submitted."""
        found: memoryview = self.device.queue.read_buffer(self.buffers[number], offset, size)
        return found

    def program(self, number: int, code: str, kinds: Mapping[str, str], entries: Sequence[str]) -> None:
        """Compile a module. kinds: of each binding "read-only-storage" or "storage"."""
        device, visible = self.device, self.wgpu.ShaderStage.COMPUTE
        bindings = [
            {"binding": int(place), "visibility": visible, "buffer": {"type": kind}} for place, kind in kinds.items()
        ]
        self.layouts[number] = device.create_bind_group_layout(entries=bindings)
        whole = device.create_pipeline_layout(bind_group_layouts=[self.layouts[number]])
        module = device.create_shader_module(code=code)
        for entry in entries:
            compute = {"module": module, "entry_point": entry}
            self.pipelines[number, entry] = device.create_compute_pipeline(layout=whole, compute=compute)

    def bind(self, number: int, program: int, buffers: Mapping[str, int]) -> None:
        """A bind group of a program. buffers: of each binding."""
        held = {int(place): self.buffers[buffer] for place, buffer in buffers.items()}
        entries = [
            {"binding": place, "resource": {"buffer": each, "offset": 0, "size": each.size}}
            for place, each in held.items()
        ]
        group = self.device.create_bind_group(layout=self.layouts[program], entries=entries)
        self.groups[number] = group, frozenset(buffers.values())

    def submit(self, commands: Sequence[Sequence[Any]]) -> None:
        """Do what was recorded; the first command is a `STAGE`."""
        encoder = self.device.create_command_encoder()
        current: Any = None
        passes = 0
        for kind, *rest in commands:
            if kind in (STAGE, CLEAR):
                if current is not None:
                    current.end()
                if kind == CLEAR:
                    encoder.clear_buffer(self.buffers[rest[0]])
                current = self._pass(encoder, passes)
                passes += 1
                continue
            program, entry, group, *numbers = rest
            current.set_pipeline(self.pipelines[program, entry])
            current.set_bind_group(0, self.groups[group][0])
            if kind == RUN:
                current.dispatch_workgroups(*numbers)
            else:
                current.dispatch_workgroups_indirect(self.buffers[numbers[0]], numbers[1])
        current.end()
        if self.timed:
            encoder.resolve_query_set(self.clock, 0, 2 * passes, self.clock_buffer, 0)
        self.device.queue.submit([encoder.finish()])

    def _pass(self, encoder: Any, place: int) -> Any:
        if not self.timed:
            return encoder.begin_compute_pass()
        written = {
            "query_set": self.clock,
            "beginning_of_pass_write_index": 2 * place,
            "end_of_pass_write_index": 2 * place + 1,
        }
        return encoder.begin_compute_pass(timestamp_writes=written)

    def times(self, passes: int) -> memoryview:
        """When the passes of the last recording began and ended, in ticks (uint64)."""
        found: memoryview = self.device.queue.read_buffer(self.clock_buffer, 0, 16 * passes)
        return found
