"""An opened graphics card: buffers, programs of WGSL shaders, and what is recorded for it to do.

A process of its own drives the card (`card_process`), so that nothing that a driver does ends this one. What is handed
over is not waited for; an error of the driver is raised when results are fetched.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Event, Thread
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...child_process import ChildError, start_child
from ...errors import GpuError
from .adapters import Adapter
from .card_process import CLEAR, RUN, RUN_PLANNED, STAGE, read_message, write_message

T = TypeVar("T")

SHADERS = Path(__file__).with_name("wgsl")
WORKGROUP = 256
ACROSS = 32768
"""Workgroups in a row of a dispatch; more go into further rows, since a dimension has at most 65,535."""
MOST_SECONDS, MOST_SECONDS_SOFTWARE = 60.0, 3600.0
"""For which a card may be silent, and a driver that computes on the CPU."""
_BINDING = re.compile(r"@binding\((\d+)\)\s+var<storage,\s*(read|read_write)>\s+(\w+)")
_ENTRY = re.compile(r"@compute.*?\nfn (\w+)", re.DOTALL)
_KINDS = {"read": "read-only-storage", "read_write": "storage"}


@dataclass(frozen=True, eq=False)
class Buffer:
    """A piece of the card's memory. size: bytes."""

    number: int
    size: int


@dataclass(frozen=True, eq=False)
class Program:
    """A compiled module. places: of each buffer's name its binding."""

    number: int
    places: Mapping[str, int]


class Card:
    """The device of an adapter. Buffers have names and are reused, or replaced when more is needed."""

    def __init__(self, adapter: Adapter, line: _Line, *, timed: bool) -> None:
        """See `open`."""
        self.adapter, self.timed = adapter, timed
        self.buffers: dict[str, Buffer] = {}
        self._line = line
        self._made = 0
        self._programs: dict[tuple[str, ...], Program] = {}
        self._bound: dict[tuple[int, ...], int] = {}

    @classmethod
    def open(cls, adapter: Adapter, *, timed: bool = False) -> Card:
        """Open an adapter's device. timed: with a clock for the stages of what is recorded, if the card has one.

        Raises:
            GpuError: it lacks what the kernels need, or its driver refuses, crashes or does not answer.
        """
        adapter.require_limits()
        line = _Line(adapter, [adapter.identity, *(["timed"] if timed else [])])
        (has_clock, *_), _ = line.answer()
        return cls(adapter, line, timed=has_clock)

    @property
    def bytes(self) -> int:
        """Of all buffers."""
        return sum(held.size for held in self.buffers.values())

    def buffer(self, name: str, values: int) -> Buffer:
        """The buffer of a name with room for at least this many 32-bit values; its contents are lost if it grows.

        Raises:
            GpuError: it is larger than the largest buffer that the card allows.
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
            self.drop(name)
        found = self.buffers[name] = Buffer(self._number(), size)
        self._line.tell("create", found.number, size)
        return found

    def upload(self, name: str, values: NDArray[Any]) -> Buffer:
        """A buffer of 32-bit values with this content."""
        found = self.buffer(name, values.size)
        self._line.tell("write", found.number, data=np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
        return found

    def download(self, name: str, kind: type, values: int, offset: int = 0) -> NDArray[Any]:
        """The first 32-bit values of a buffer, after all work that was submitted.

        Raises:
            GpuError: the card failed since the last download, or it has no more memory.
        """
        self._line.tell("read", self.buffers[name].number, 4 * offset, 4 * values)
        _, read = self._line.answer()
        return np.frombuffer(read, kind, values)

    def drop(self, name: str) -> None:
        """Free the memory of a buffer."""
        number = self.buffers.pop(name).number
        self._bound = {key: group for key, group in self._bound.items() if number not in key[1:]}
        self._line.tell("destroy", number)

    def program(self, *files: str, **constants: float) -> Program:
        """The module of these files of `wgsl`, one after another, with constants of type f32."""
        lines = tuple(f"const {name}: f32 = {float(value)!r};" for name, value in constants.items())
        if (key := (*lines, *files)) not in self._programs:
            code = "\n".join([*lines, *map(_source, files)])
            found = _BINDING.findall(code)
            program = Program(self._number(), {name: int(place) for place, _, name in found})
            kinds = {place: _KINDS[access] for place, access, _ in found}
            self._line.tell("program", program.number, code, kinds, _ENTRY.findall(code))
            self._programs[key] = program
        return self._programs[key]

    def bind(self, program: Program, buffers: Mapping[str, Buffer]) -> int:
        """The number of the bind group of a program with its buffers by name."""
        numbers = {place: buffers[name].number for name, place in program.places.items()}
        key = (program.number, *numbers.values())
        if key not in self._bound:
            self._bound[key] = self._number()
            self._line.tell("bind", self._bound[key], program.number, numbers)
        return self._bound[key]

    def record(self) -> Recording:
        """Begin the next commands of the card."""
        return Recording(self)

    def submit(self, commands: Sequence[Sequence[Any]]) -> None:
        """Hand over what was recorded."""
        self._line.tell("submit", commands)

    def times(self, passes: int) -> NDArray[np.float64]:
        """(passes, 2) when the passes of the last recording began and ended, in ticks."""
        self._line.tell("times", passes)
        return np.frombuffer(self._line.answer()[1], np.uint64).reshape(-1, 2).astype(np.float64)

    def close(self) -> None:
        """End the card's process."""
        self._line.close()

    def _number(self) -> int:
        """A number that nothing has yet."""
        self._made += 1
        return self._made


class Recording:
    """A list of dispatches, handed to the card together."""

    def __init__(self, card: Card) -> None:
        self._card = card
        self._stages = [""]
        self._commands: list[list[Any]] = [[STAGE]]

    def stage(self, name: str) -> None:
        """What follows belongs to the stage of this name; only a card with a clock takes note."""
        if self._card.timed:
            self._stages.append(name)
            self._commands.append([STAGE])

    def run(self, program: Program, entry: str, buffers: Mapping[str, Buffer], *groups: int) -> None:
        """Dispatch an entry point with this many workgroups (x, y, z)."""
        self._commands.append([RUN, program.number, entry, self._card.bind(program, buffers), *groups])

    def run_for(self, program: Program, entry: str, buffers: Mapping[str, Buffer], invocations: int) -> None:
        """Dispatch an entry point with at least this many invocations, in rows of `ACROSS` workgroups."""
        groups = -(-max(invocations, 1) // WORKGROUP)
        across = min(groups, ACROSS)
        self.run(program, entry, buffers, across, -(-groups // across), 1)

    def run_planned(
        self, program: Program, entry: str, buffers: Mapping[str, Buffer], plan: Buffer, place: int
    ) -> None:
        """Dispatch an entry point with the numbers of workgroups that lie at a 32-bit place of `plan`."""
        group = self._card.bind(program, buffers)
        self._commands.append([RUN_PLANNED, program.number, entry, group, plan.number, 4 * place])

    def clear(self, buffer: Buffer) -> None:
        """Fill a buffer with 0."""
        self._commands.append([CLEAR, buffer.number])
        self._stages.append(self._stages[-1])

    def submit(self) -> None:
        """Hand it to the card."""
        self._card.submit(self._commands)

    def shares(self) -> dict[str, float]:
        """Of the card's time for what was submitted: the share of each stage; empty without a clock."""
        if not self._card.timed:
            return {}
        taken: dict[str, float] = {}
        for name, (begin, end) in zip(self._stages, self._card.times(len(self._stages)), strict=True):
            taken[name] = taken.get(name, 0.0) + max(end - begin, 0.0)
        whole = sum(taken.values())
        return {name: each / whole for name, each in taken.items() if name} if whole > 0.0 else {}


class _Line:
    """The connection to the process of a card. One that is silent for too long is ended."""

    def __init__(self, adapter: Adapter, arguments: Sequence[str]) -> None:
        self._name = adapter.name
        self._most_seconds = MOST_SECONDS_SOFTWARE if adapter.software else MOST_SECONDS
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  closed by `close`
        try:
            self._child = start_child("splatting.gpu.card_process", arguments, errors=self._log)
        except ChildError as error:
            raise GpuError(f"{adapter.name} cannot be opened: {error}") from error
        self._watch = _Watch(self._child)
        self.close = weakref.finalize(self, _end, self._child, self._watch, self._log)

    def tell(self, *words: Any, data: bytes | memoryview = b"") -> None:
        """Send a message.

        Raises:
            GpuError: the process has ended, or takes nothing any more.
        """
        stream = self._child.stdin
        assert stream is not None
        self._within_time(lambda: write_message(stream, words, data))

    def answer(self) -> tuple[list[Any], bytearray]:
        """The answer to the last message that asks for something, without its error.

        Raises:
            GpuError: the card failed since the last answer, or its process has ended.
        """
        stream = self._child.stdout
        assert stream is not None
        (failure, *rest), data = self._within_time(lambda: read_message(stream))
        if failure:
            raise GpuError(f"{self._name} failed: {failure}")
        return rest, data

    def _within_time(self, work: Callable[[], T]) -> T:
        self._watch.until = time.monotonic() + self._most_seconds
        try:
            return work()
        except (OSError, EOFError, ValueError) as error:  # ValueError: the stream was closed
            if self._watch.ended:
                raise GpuError(f"{self._name} failed: it did not answer in {self._most_seconds:.0f} s") from error
            code = self._child.wait()
            raise GpuError(f"{self._name} failed: its process ended with code {code}{self._last_line()}") from error
        finally:
            self._watch.until = None

    def _last_line(self) -> str:
        """What the process wrote last, in brackets."""
        if self._log.closed:
            return ""
        self._log.seek(0)
        written = self._log.read().decode("utf-8", "replace").strip().splitlines()
        return f" ({written[-1].strip()})" if written else ""


class _Watch:
    """Ends a process at `until`, if that comes. ended: whether it did."""

    def __init__(self, child: subprocess.Popen[bytes]) -> None:
        self.until: float | None = None
        self.ended = False
        self.stop = Event()
        Thread(target=self._look, args=(child,), daemon=True).start()

    def _look(self, child: subprocess.Popen[bytes]) -> None:
        while not self.stop.wait(0.5):
            until = self.until
            if until is not None and time.monotonic() > until:
                self.ended = True
                child.kill()
                return


def _end(child: subprocess.Popen[bytes], watch: _Watch, log: IO[bytes]) -> None:
    """End a card's process, whatever it is doing."""
    watch.stop.set()
    child.kill()
    child.wait()
    for stream in (child.stdin, child.stdout, log):
        try:
            if stream is not None:
                stream.close()
        except OSError:  # what was not sent yet
            continue


@cache
def _source(name: str) -> str:
    return (SHADERS / f"{name}.wgsl").read_text(encoding="utf-8")
