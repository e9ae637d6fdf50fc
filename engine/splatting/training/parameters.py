"""The trained values: the parameters of the Gaussians and the moments of the optimiser, kept together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...compiled.jit import threads
from ..gaussians import PARAMETERS, Gaussians
from ..kernels.adam import CORRECTIONS, adam_step

CHANNELS = "channels"
"""The name of further channels of Gaussians, in addition to the parameters of `Gaussians`."""


@dataclass(frozen=True)
class Rates:
    """Learning rates of one step; `sh_rest` is for the harmonics beyond the constant one, `channels` for further
    channels."""

    means: float
    log_scales: float
    quats: float
    opacity_logits: float
    sh: float
    sh_rest: float
    channels: float = 0.0

    def columns(self, name: str, sh_degree: int, channels: int = 0) -> NDArray[np.float32]:
        """One rate for each value of a Gaussian's parameter; harmonics up to `sh_degree` only."""
        if name == CHANNELS:
            return np.full(channels, self.channels, np.float32)
        if name == "sh":
            return np.array([self.sh] * 3 + [self.sh_rest] * (3 * ((sh_degree + 1) ** 2 - 1)), np.float32)
        return np.full({"quats": 4, "opacity_logits": 1}.get(name, 3), getattr(self, name), np.float32)


@dataclass(eq=False)
class Parameters:
    """Gaussians under training: values and Adam's first and second moments by the field names of `Gaussians`.

    They may include `CHANNELS`, (N, C). All tensors are contiguous float32 of one length. updates: (N,) int32 how often
    each Gaussian was updated; step: number of updates so far.
    """

    values: dict[str, Tensor]
    first: dict[str, Tensor]
    second: dict[str, Tensor]
    updates: Tensor
    step: int = 0

    @staticmethod
    def start(gaussians: Gaussians, channels: int = 0) -> Parameters:
        """Zero moments for these Gaussians, and this many further channels of 0."""
        values = {name: getattr(gaussians, name).detach().float().contiguous().clone() for name in PARAMETERS}
        if channels > 0:
            values[CHANNELS] = torch.zeros(len(gaussians), channels)
        return Parameters(
            values=values,
            first={name: torch.zeros_like(value) for name, value in values.items()},
            second={name: torch.zeros_like(value) for name, value in values.items()},
            updates=torch.zeros(len(gaussians), dtype=torch.int32),
        )

    def __len__(self) -> int:
        return len(self.values["means"])

    def gaussians(self) -> Gaussians:
        """The current values; the tensors are shared."""
        means, log_scales, quats, opacity_logits, sh = (self.values[name] for name in PARAMETERS)
        return Gaussians(means, log_scales, quats, opacity_logits, sh)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The current values of the Gaussians; the memory is shared."""
        return {name: self.values[name].numpy() for name in PARAMETERS}

    def channels(self) -> NDArray[np.float32]:
        """(N, C) the current further channels, C = 0 if there are none; the memory is shared."""
        held = self.values.get(CHANNELS)
        return np.zeros((len(self), 0), np.float32) if held is None else held.numpy()

    def select(self, index: Tensor) -> None:
        """Keep the Gaussians at `index` (mask or integers) with their moments."""
        for table in (self.values, self.first, self.second):
            for name, value in table.items():
                table[name] = value[index].contiguous()
        self.updates = self.updates[index].contiguous()

    def append(self, gaussians: Gaussians, sources: Tensor) -> None:
        """Add Gaussians with zero moments, as 3DGS does; sources: (A,) whose further channels they copy."""
        for name in self.values:
            added = self.values[name][sources] if name == CHANNELS else getattr(gaussians, name).detach().float()
            self.values[name] = torch.cat([self.values[name], added])
            for moments in (self.first, self.second):
                moments[name] = torch.cat([moments[name], torch.zeros_like(added)])
        self.updates = torch.cat([self.updates, torch.zeros(len(gaussians), dtype=torch.int32)])

    def forget(self, name: str) -> None:
        """Set one parameter's moments to zero."""
        self.first[name].zero_()
        self.second[name].zero_()

    def update(
        self, gradients: Mapping[str, NDArray[np.float32]], rates: Rates, sh_degree: int, drawn: NDArray[np.int32]
    ) -> None:
        """One step of Adam for the Gaussians that were rendered; harmonics above `sh_degree` stay unchanged.

        drawn: (N,) not 0 if a view rendered the Gaussian; other rows of the gradients are not read. A Gaussian that is
        not in view keeps its moments, as if those steps had not happened. Channels without a gradient stay.
        """
        self.step += 1
        self.updates += torch.from_numpy(drawn != 0)
        n = len(self)
        for name in self.values:
            if name not in gradients:
                continue
            tables = (
                table.reshape(n, -1)
                for table in (
                    self.values[name].numpy(), gradients[name], self.first[name].numpy(), self.second[name].numpy()
                )
            )  # fmt: skip
            columns = rates.columns(name, sh_degree, self.values[name].shape[-1])
            adam_step(threads(), *tables, columns, drawn, self.updates.numpy(), CORRECTIONS)
