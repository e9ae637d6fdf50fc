"""What trains: the text of the panel, found without making Blender wait for drivers."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache

ON_CPU = "Trains on the CPU"


def describe_device(wanted: str) -> str:
    """Say which device a setting names, for people; empty until the drivers have answered."""
    found = _start_answer(wanted.strip() or "auto")
    return found.result() if found.done() else ""


@cache
def _start_answer(wanted: str) -> Future[str]:
    pool = ThreadPoolExecutor(1)
    answer = pool.submit(_answer, wanted)
    pool.shutdown(wait=False)
    return answer


def _answer(wanted: str) -> str:
    from ...engine.errors import GpuError
    from ...engine.splatting.gpu.adapters import choose_adapter

    try:
        adapter = choose_adapter(wanted)
    except GpuError as error:
        return str(error)
    return ON_CPU if adapter is None else f"Trains on {adapter.name} ({adapter.backend})"
