"""A small network that says whether a sphere is a fruit, and where and how large the fruit is, from what several photos
show.

Each chosen view gives a crop of the probability of the prompt, of the depth, and of the fruit that are already known. A
convolutional network turns every crop into a shift of the centre with its error, a weight and a few numbers; the
shifts of all views together move the centre in space, and the numbers together give the probability and the radius. It
sees neither colours nor words, so it serves every prompt. The answers of two such networks are averaged. Trained by
`scripts/developer/fit_verifier.py` on rendered trees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ...errors import EncoderError
from ...storage.files import halve_precision, read_tensors, write_tensors
from .places import Places
from .surroundings import Surroundings
from .view_kernels import CHANNELS
from .views import PhotoViews

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

STORED = Path(__file__).with_name("verifier.safetensors")
FORMAT = "fruitlangs-verifier-5"
CELLS, SPAN = 16, 2.0
"""Cells along each side of a crop, and radii to each side that it covers."""
VIEWS = 16
"""Most views of a sphere that are used."""
FEWEST_VIEWS = 2
"""A sphere that fewer views show is no fruit."""
KNOWN = 24
"""Most known fruit in the surroundings of a sphere."""
KNOWN_REACH = 2.6
"""Diameters of the largest known fruit within which known fruit are drawn into the crops."""
NUMBERS = 32
"""Numbers that a view gives besides shift, error and weight."""
SCENE = 15
"""Numbers about a sphere that do not come from crops: of all views, its size in the maps, and of the Gaussians."""
STIFF = 0.1
"""Weight, as an error of a pixel's square over a radius' square, that keeps a centre which no view locates."""
FARTHEST = 1.0
"""Radii that a centre moves at most."""
LAPLACE = math.sqrt(2.0)
"""Standard deviation over mean absolute error, of errors as the network is trained for."""
MOST_GROWTH = 0.3
"""Logarithm by which a radius grows or shrinks at most at once."""
UNUSUAL, UNUSUAL_SD, UNKNOWN_SPREAD = 2.0, 0.15, 0.4
"""Spreads of the logarithm of sizes by which fruit may be larger than the usual one, and its standard deviation beyond:
a ball of three usual diameters is no fruit, whatever its shape. The spread before any fruit are known."""
AT_ONCE = 250
"""Spheres whose crops are in memory together."""
UNSEEN = -9.0
"""Log odds of a sphere that too few views show."""


class Network(nn.Module):
    """Crops (n, K, CHANNELS, CELLS, CELLS), which of them exist (n, K), and numbers of the scene (n, SCENE) → log odds
    (n,), shifts of the centre (n, K, 2) in radii, the logarithm of the error of each (n, K), the logarithm by which the
    radius grows (n,), and the logarithm of the mean absolute error of this (n,)."""

    def __init__(self) -> None:
        super().__init__()
        self.crop = nn.Sequential(
            nn.Conv2d(CHANNELS, 24, 4, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(24, 32, 3, padding=1), nn.ReLU(),
            nn.Conv2d(32, 48, 4, stride=2, padding=1), nn.ReLU(), nn.Flatten(),
            nn.Linear(48 * (CELLS // 4) ** 2, 48), nn.ReLU(), nn.Linear(48, 4 + NUMBERS),
        )  # fmt: skip
        self.together = nn.Sequential(
            nn.Linear(2 * NUMBERS + 1 + SCENE, 64), nn.ReLU(), nn.Dropout(0.1), nn.Linear(64, 3)
        )

    def forward(self, crops: Tensor, exists: Tensor, scene: Tensor) -> Answers:
        n, k = exists.shape
        index = exists.reshape(-1).nonzero()[:, 0]
        said = self.crop(crops.reshape(n * k, *crops.shape[2:])[index])
        views = said.new_zeros(n * k, said.shape[1]).index_copy(0, index, said).reshape(n, k, -1)
        weights = torch.sigmoid(views[..., 3]) * exists
        numbers = torch.relu(views[..., 4:]) * exists[..., None]
        total = weights.sum(1, keepdim=True)
        mean = (numbers * weights[..., None]).sum(1) / (total + 1e-3)
        joined = torch.cat([mean, numbers.amax(1), torch.log1p(total), scene], dim=1)
        odds, growths, size_errors = self.together(joined).unbind(1)
        return odds, views[..., :2], views[..., 2].clamp(-4.0, 3.0), growths, size_errors.clamp(-4.0, 1.0)


Answers = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""What a `Network` returns."""


class Networks(nn.Module):
    """Networks whose answers are averaged: each one errs in other places."""

    def __init__(self, networks: Sequence[Network]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, crops: Tensor, exists: Tensor, scene: Tensor) -> Answers:
        answers = zip(*(network(crops, exists, scene) for network in self.networks), strict=True)
        odds, shifts, errors, growths, size_errors = (torch.stack(each).mean(0) for each in answers)
        return odds, shifts, errors, growths, size_errors


@dataclass(frozen=True, eq=False)
class Looked:
    """What the network is given of C spheres: crops, chosen views (C, K), numbers of the scene (C, SCENE)."""

    crops: NDArray[np.float32]
    chosen: IntArray
    scene: NDArray[np.float32]


def look(
    views: PhotoViews,
    surroundings: Surroundings,
    centers: FloatArray,
    radii: FloatArray,
    others: FloatArray,
    other_radii: FloatArray,
    near: IntArray,
) -> Looked:
    """Cut out what the network needs of C spheres, centers (C, 3) and radii (C,); near: (C, M) which of the known fruit
    `others` (O, 3) are near each, -1 after the last."""
    centers, radii = np.ascontiguousarray(centers), np.ascontiguousarray(radii)
    chosen, sums = views.choose(centers, radii, VIEWS)
    crops = views.crops(centers, radii, chosen, others, other_radii, near, cells=CELLS, span=SPAN)
    shares = sums[:, :4] / np.maximum(sums[:, 4:], 1.0)
    wide = np.log(np.maximum(views.pixels_wide(centers, radii, chosen), 1.0))[:, None]
    scene = np.concatenate([np.log1p(sums), shares, wide, surroundings.numbers(centers, radii)], axis=1)
    return Looked(crops, chosen, scene.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Verdicts:
    """What photos say of C places: log_odds: (C,) that they hold fruit; moves: (C, 3) to where that fruit is, scene
    units; growths: (C,) the logarithm of its radius over that of the place; radius_sds: (C,) the standard deviation of
    the logarithm of its radius."""

    log_odds: FloatArray
    moves: FloatArray
    growths: FloatArray
    radius_sds: FloatArray

    def select(self, index: NDArray) -> Verdicts:
        """Those of the places at `index` (bool mask (C,) or integer indices)."""
        return Verdicts(*(getattr(self, each.name)[index] for each in fields(self)))

    @staticmethod
    def join(parts: Sequence[Verdicts]) -> Verdicts:
        """Those of the places of all parts, one after the other."""
        return Verdicts(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Verdicts)))


@dataclass(frozen=True, eq=False)
class Verifier:
    """The network with what it looks at. views: of the scene; surroundings: its Gaussians; spread: standard deviation
    of the logarithm of the radii of its fruit."""

    network: Network | Networks
    views: PhotoViews
    surroundings: Surroundings
    spread: float = UNKNOWN_SPREAD

    def with_size(self, diameter: float, spread: float = UNKNOWN_SPREAD) -> Verifier:
        """Return the same for fruit of another usual diameter, scene units, and spread."""
        return replace(self, surroundings=replace(self.surroundings, diameter=diameter), spread=spread)

    @torch.inference_mode()
    def verify(self, places: Places, others: Places, own: IntArray | None = None) -> Verdicts:
        """What photos say of places, of the fruit there that the `others`, known fruit, leave unexplained; own: (C,)
        which of the others each place is itself, -1 for none."""
        count = len(places)
        verdicts = Verdicts(np.full(count, UNSEEN), np.zeros((count, 3)), np.zeros(count), np.ones(count))
        near = find_known_near(places.centers, others, own)
        for start in range(0, count, AT_ONCE):
            part = slice(start, start + AT_ONCE)
            centers, radii = places.centers[part], places.radii[part]
            looked = look(self.views, self.surroundings, centers, radii, others.centers, others.radii, near[part])
            exists = torch.from_numpy(looked.chosen >= 0)
            odds, shifts, errors, growths, size_errors = self.network(
                torch.from_numpy(looked.crops), exists, torch.from_numpy(looked.scene)
            )
            grown = growths.clamp(-MOST_GROWTH, MOST_GROWTH).double().numpy()
            seen = torch.where(exists.sum(1) >= FEWEST_VIEWS, odds, UNSEEN).double().numpy()
            verdicts.log_odds[part] = seen - self._doubt_unusual(radii * np.exp(grown))
            verdicts.moves[part] = self._moves(centers, radii, looked.chosen, shifts, errors)
            verdicts.growths[part] = grown
            verdicts.radius_sds[part] = LAPLACE * size_errors.exp().double().numpy()
        return verdicts

    def _doubt_unusual(self, radii: FloatArray) -> FloatArray:
        """Return the log odds (C,) against fruit of radii (C,) that are larger than the usual one by more than UNUSUAL
        spreads."""
        off = np.log(2.0 * radii / self.surroundings.diameter)
        unusual: FloatArray = 0.5 * (np.maximum(off - UNUSUAL * self.spread, 0.0) / UNUSUAL_SD) ** 2
        return unusual

    def _moves(
        self, centers: FloatArray, radii: FloatArray, chosen: IntArray, shifts: Tensor, errors: Tensor
    ) -> FloatArray:
        """(C, 3) the moves that fit the shifts of all views best, weighted by their errors."""
        _, depths = self.views.project(centers, chosen)
        pixels = self.views.lenses[np.maximum(chosen, 0), :2] * (radii[:, None] / depths)[..., None]
        weights = (np.exp(-2.0 * errors.double().numpy()) * (chosen >= 0))[..., None] / pixels**2
        slopes, wanted = self.views.slopes(centers, chosen), shifts.double().numpy() * pixels
        normal = (
            np.einsum("ckx,ckxi,ckxj->cij", weights, slopes, slopes) + np.eye(3) * (STIFF / radii**2)[:, None, None]
        )
        moves = np.linalg.solve(normal, np.einsum("ckx,ckxi,ckx->ci", weights, slopes, wanted)[..., None])[..., 0]
        lengths = np.linalg.norm(moves, axis=1, keepdims=True)
        return moves * np.minimum(1.0, FARTHEST * radii[:, None] / np.maximum(lengths, 1e-12))


def find_known_near(centers: FloatArray, others: Places, own: IntArray | None = None) -> IntArray:
    """Find the nearest (C, KNOWN) of the others within KNOWN_REACH of each centre (C, 3), without its own (C,), -1
    after the last."""
    near = np.full((len(centers), KNOWN), -1, np.int64)
    if len(others) == 0:
        return near
    reach = KNOWN_REACH * 2.0 * others.largest
    distances, found = cKDTree(others.centers).query(centers, k=KNOWN + 1, distance_upper_bound=reach)
    usable = np.isfinite(distances)
    if own is not None:
        usable &= found != own[:, None]
    order = np.argsort(~usable, axis=1, kind="stable")[:, :KNOWN]
    kept = np.take_along_axis(usable, order, 1)
    near[:, : order.shape[1]] = np.where(kept, np.take_along_axis(found, order, 1), -1)
    return near


def write_networks(path: Path, networks: Networks, notes: Sequence[Mapping[str, Any]], encoder_id: str) -> None:
    """Write networks in half precision. notes: of each, the trees that it was trained and calibrated on; encoder_id:
    `fruit_identity` of the encoder whose maps they were trained for."""
    header = {"format": FORMAT, "encoder": encoder_id, "networks": list(notes)}
    write_tensors(path, halve_precision(networks.state_dict()), header)


@dataclass(frozen=True, eq=False)
class StoredNetworks:
    """What `write_networks` wrote. networks: ready for inference."""

    networks: Networks
    notes: Sequence[Mapping[str, Any]]
    encoder_id: str


@cache
def read_networks(path: Path) -> StoredNetworks:
    """Read what `write_networks` wrote.

    Raises:
        EncoderError: the file is missing, damaged or of another version.
    """
    try:
        tensors, header = read_tensors(path)
        if header["format"] != FORMAT:
            raise ValueError(f"it holds {header['format']}")
        networks = Networks([Network() for _ in header["networks"]])
        networks.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        return StoredNetworks(networks.eval(), header["networks"], str(header["encoder"]))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise EncoderError(
            f"The weights {path} cannot be read ({str(error).splitlines()[0]}). Install the package again"
        ) from error


def load_networks() -> Networks:
    """Load the networks that come with the package."""
    return read_networks(STORED).networks


def require_trained_for(encoder_id: str, path: Path = STORED) -> None:
    """Refuse to verify fruit in maps of networks that the verifier was not trained for: its crops show their offsets.

    encoder_id: `fruit_identity` of the encoder that makes the maps.

    Raises:
        EncoderError: the file is missing, damaged, or was trained for other networks.
    """
    trained_for = read_networks(path).encoder_id
    if trained_for != encoder_id:
        raise EncoderError(
            f"The weights {path} were trained for {trained_for}, not for {encoder_id}. Install the package again, or "
            "train them again with scripts/developer/fit_verifier.py"
        )
