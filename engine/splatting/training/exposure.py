"""Exposure and white balance of photos: an affine colour map per view, learnt together with the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.exposure import change_colors, colors_backward
from ..rendering.workspace import Workspace
from .view_adam import ViewMoments, decay_rate

RATE, LAST_RATE = 5e-3, 5e-4
"""Adam's learning rate at the first and at the last step; 3DGS's own exposure model ends at the same order."""
PULL = 0.01
"""Weight of ½|matrix - identity|²: photos agree on what is neutral unless they differ."""
IDENTITY = np.eye(3, 4, dtype=np.float32)


@dataclass(eq=False)
class Exposures(ViewMoments):
    """Affine colour maps, with Adam's moments of them.

    matrices: (V, 3, 4) float32, photo = matrix · (red, green, blue, 1) of the Gaussians.
    """

    matrices: NDArray[np.float32]

    @staticmethod
    def neutral(views: int) -> Exposures:
        """No change of any photo's colours."""
        zeros = np.zeros((views, 3, 4), np.float32)
        return Exposures(zeros.copy(), zeros.copy(), np.zeros(views, np.int32), zeros + IDENTITY)

    def apply(self, view: int, image: NDArray[np.float32], workspace: Workspace) -> NDArray[np.float32]:
        """The image (3, H, W) with the colours of the view's photo."""
        changed = workspace.take("exposed", image.shape)
        change_colors(image, self.matrices[view], changed)
        return changed

    def learn(
        self, view: int, image: NDArray[np.float32], gradient: NDArray[np.float32], done: float, workspace: Workspace
    ) -> None:
        """Turn the gradient of the mapped image (3, H, W) into that of the image, in place, and update the map of the
        view.

        done: share of the training that is over.
        """
        row_sums = workspace.take("exposure_rows", (image.shape[1], 3, 4))
        colors_backward(image, self.matrices[view], gradient, row_sums)
        self.update(view, row_sums.sum(0, dtype=np.float64), done)

    def update(self, view: int, sums: NDArray[np.float64], done: float) -> None:
        """Update the map of a view. sums: (3, 4) gradient of the loss; done: as in `learn`."""
        g = sums + PULL * (self.matrices[view] - IDENTITY)
        self.matrices[view] -= self.step(view, g, decay_rate(RATE, LAST_RATE, done)).astype(np.float32)


def fit_exposure(
    image: NDArray[np.float32], photo: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> NDArray[np.float32]:
    """Apply to the image (H, W, 3) the affine colour change that brings it nearest to a photo (least squares).

    A held-out photo has no learnt map; its colours are matched before it is compared.
    """
    use = np.ones(photo.shape[:2], bool) if mask is None else mask
    columns = np.concatenate([image[use], np.ones((int(use.sum()), 1), np.float32)], 1).astype(np.float64)
    gram = columns.T @ columns + 1e-6 * len(columns) * np.eye(4)
    matrix = np.linalg.solve(gram, columns.T @ (photo[use] / 255.0) + 1e-6 * len(columns) * np.eye(4, 3))
    return (image @ matrix[:3] + matrix[3]).astype(np.float32)
