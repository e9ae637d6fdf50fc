"""The features of Gaussians, and their file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from ...errors import FormatError
from ...storage.files import read_tensors, write_tensors

FORMAT = "fruitlangs-features-2"


@dataclass(frozen=True, eq=False)
class Perceptron:
    """Linear layers with ReLU in between, from unit vectors to unit vectors: one half of an autoencoder.

    weights: (out, in) and biases: (out,) of each layer, float32.
    """

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]

    def __call__(self, vectors: Tensor) -> Tensor:
        """(…, in) → (…, out) unit. Inputs are normalised first; a vector of length 0 gives a zero vector."""
        values = functional.normalize(vectors.float(), dim=-1)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = functional.linear(values.relu() if layer else values, weight, bias)
        return functional.normalize(values, dim=-1) * (vectors.abs().amax(-1, keepdim=True) > 0)


@dataclass(frozen=True, eq=False)
class Features:
    """Features of N Gaussians at L levels of masks, which any prompt can query at any later time.

    vectors: (N, L, D) unit, float32 or float16, zero if the weight is 0; with decoders, codes (N, L, d) of such
    vectors; weights: (N, L) float32, pixels covered by the Gaussian (Σ α·T) that have a feature, summed over views;
    agreement: (N, L) float32, agreement of the views: the mean cosine between the contribution of each view and the
    result, weighted by the contribution, 0 if the weight is 0; encoder_id: identity of the encoder; decoders: none, one
    for all levels or one per level; gaussians: the `gaussians_id` of their Gaussians, empty in older files; embedding:
    (N, E) float16, what taught words are learnt from (see `FruitView`); None if the encoder has none, and in older
    files.

    An encoder of whole photos has one level. 100,000 Gaussians with 3 levels of 512 take 293 MB in half precision, in
    memory as on disk, twice that in single; cosines change by less than 1e-3.
    """

    vectors: Tensor
    weights: Tensor
    agreement: Tensor
    encoder_id: str
    decoders: tuple[Perceptron, ...] = ()
    gaussians: str = ""
    embedding: Tensor | None = None

    def __len__(self) -> int:
        return self.vectors.shape[0]

    @property
    def levels(self) -> int:
        return self.vectors.shape[1]

    def unit(self, level: int, rows: slice | Tensor = slice(None)) -> Tensor:
        """(n, D) float32 unit features of one level in the space of the encoder's words, decoded if they are codes."""
        vectors = self.vectors[rows, level].float()
        if self.decoders:
            return self.decoders[level if len(self.decoders) > 1 else 0](vectors)
        return vectors

    def evidence(self, rows: slice | Tensor = slice(None)) -> Tensor:
        """(n, F) float32 from which taught words are learnt: the embedding, or unit features of all levels where there
        is none."""
        if self.embedding is not None:
            return self.embedding[rows].float()
        return torch.cat([self.unit(level, rows) for level in range(self.levels)], dim=1)

    def of(self, means: Tensor) -> Features:
        """The same features, marked as those of the Gaussians at means (N, 3)."""
        return replace(self, gaussians=gaussians_id(means))

    def are_of(self, means: Tensor) -> bool:
        """Whether these are features of the Gaussians at means (N, 3), as far as they record it."""
        return len(self) == len(means) and self.gaussians in ("", gaussians_id(means))


def gaussians_id(means: Tensor) -> str:
    """An id of the Gaussians at means (N, 3), different for any other training: a hash of the means."""
    return hashlib.sha256(means.detach().cpu().float().contiguous().numpy().tobytes()).hexdigest()


def blocks(n: int, size: int) -> list[slice]:
    """Ranges of at most `size` rows."""
    return [slice(begin, min(begin + size, n)) for begin in range(0, n, max(size, 1))]


def save_features(path: Path, features: Features) -> None:
    """Write `features.safetensors` atomically; its header names the Gaussians and the encoder.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {
        "format": FORMAT,
        "encoder_id": features.encoder_id,
        "decoders": len(features.decoders),
        "gaussians": features.gaussians,
    }
    tensors = {name: getattr(features, name).contiguous() for name in ("vectors", "weights")}
    tensors["agreement"] = features.agreement.half()
    if features.embedding is not None:
        tensors["embedding"] = features.embedding.contiguous()
    for number, decoder in enumerate(features.decoders):
        for part in ("weights", "biases"):
            for layer, tensor in enumerate(getattr(decoder, part)):
                tensors[f"decoder.{number}.{part}.{layer}"] = tensor.contiguous()
    write_tensors(path, tensors, header)


def load_features(path: Path) -> Features:
    """Read features written by `save_features`.

    Raises:
        FormatError: the file is missing, damaged, of an earlier version or something else.
    """
    try:
        tensors, header = read_tensors(path)
        if header["format"] != FORMAT:
            raise FormatError(f"{path} holds {header['format']}, not {FORMAT}. Count again from the photos")
        decoders = tuple(_read_decoder(tensors, number) for number in range(int(header["decoders"])))
        features = Features(
            tensors["vectors"],
            tensors["weights"],
            tensors["agreement"].float(),
            str(header["encoder_id"]),
            decoders,
            str(header.get("gaussians", "")),
            tensors.get("embedding"),
        )
        shape = features.vectors.shape
        if len(shape) != 3 or not shape[:2] == features.weights.shape == features.agreement.shape:
            raise ValueError(f"its tensors do not fit: {tuple(shape)} and {tuple(features.weights.shape)}")
        if features.embedding is not None and (
            features.embedding.ndim != 2 or len(features.embedding) != len(features)
        ):
            raise ValueError(f"its embedding does not fit: {tuple(features.embedding.shape)}")
        if len(decoders) not in (0, 1, features.levels):
            raise ValueError(f"{len(decoders)} decoders for {features.levels} levels")
        return features
    except (KeyError, ValueError, TypeError) as error:
        raise FormatError(f"{path} holds no features ({str(error).splitlines()[0]}). Lift them again") from error


def _read_decoder(tensors: dict[str, Tensor], number: int) -> Perceptron:
    layers = sum(name.startswith(f"decoder.{number}.weights.") for name in tensors)
    weights, biases = (
        tuple(tensors[f"decoder.{number}.{part}.{layer}"] for layer in range(layers)) for part in ("weights", "biases")
    )
    if not layers or not all(torch.isfinite(tensor).all() for tensor in (*weights, *biases)):
        raise ValueError(f"decoder {number} is missing or broken")
    return Perceptron(weights, biases)
