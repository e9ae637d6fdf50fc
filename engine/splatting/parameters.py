"""What training moves: the Gaussians' parameters and the optimiser's moments, together as Gaussians come and go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from .adam_kernels import BETA_1, BETA_2, adam_step
from .gaussians import Gaussians

RUN = 2048
"""About how many parameters a thread updates before it asks for more."""
NAMES = tuple(field.name for field in fields(Gaussians))


@dataclass(frozen=True)
class Rates:
    """Learning rates of one step; `sh_rest` is for the harmonics beyond the constant one."""

    means: float
    log_scales: float
    quats: float
    opacity_logits: float
    sh: float
    sh_rest: float


@dataclass(eq=False)
class Parameters:
    """Gaussians under training: values and Adam's first and second moments by the field names of `Gaussians`.

    All tensors are contiguous float32 of one length; step counts the updates so far.
    """

    values: dict[str, Tensor]
    first: dict[str, Tensor]
    second: dict[str, Tensor]
    step: int = 0

    @staticmethod
    def start(gaussians: Gaussians) -> Parameters:
        """Fresh moments for these Gaussians."""
        values = {name: getattr(gaussians, name).detach().float().contiguous().clone() for name in NAMES}
        return Parameters(
            values=values,
            first={name: torch.zeros_like(value) for name, value in values.items()},
            second={name: torch.zeros_like(value) for name, value in values.items()},
        )

    def __len__(self) -> int:
        return len(self.values["means"])

    def gaussians(self) -> Gaussians:
        """The current values; the tensors are shared."""
        return Gaussians(**self.values)

    def select(self, index: Tensor) -> None:
        """Keep the Gaussians at `index` (mask or integers) with their moments."""
        for table in (self.values, self.first, self.second):
            for name, value in table.items():
                table[name] = value[index].contiguous()

    def append(self, gaussians: Gaussians) -> None:
        """Add Gaussians with moments of zero, as 3DGS does."""
        for name in NAMES:
            added = getattr(gaussians, name).detach().float()
            self.values[name] = torch.cat([self.values[name], added])
            for moments in (self.first, self.second):
                moments[name] = torch.cat([moments[name], torch.zeros_like(added)])

    def forget(self, name: str) -> None:
        """Set one parameter's moments to zero."""
        self.first[name].zero_()
        self.second[name].zero_()

    def update(self, gradients: Mapping[str, Tensor], rates: Rates, sh_degree: int) -> None:
        """One step of Adam; harmonics above `sh_degree` stay as they are."""
        self.step += 1
        correction = np.float32((1.0 - float(BETA_2) ** self.step) ** -0.5)
        for name in NAMES:
            tables = [table[name].reshape(-1).numpy() for table in (self.values, gradients, self.first, self.second)]
            width = self.values[name][0].numel() if len(self) > 0 else 1
            columns = np.full(width, getattr(rates, name), np.float32)
            if name == "sh":
                columns[3:] = rates.sh_rest
                columns[3 * (sh_degree + 1) ** 2 :] = 0.0
            columns /= np.float32(1.0 - float(BETA_1) ** self.step)
            adam_step(*tables, np.tile(columns, -(-RUN // width)), correction)
