"""The scale of a reconstruction: from the settings, from the photos' GPS tags, or the one it already had."""

from __future__ import annotations

import dataclasses

from .config import UnitsConfig
from .errors import SceneError
from .language.encoders.encoder import Encoder
from .language.prompts.relevancy import relevancy
from .reconstruction import Reconstruction
from .scene.formats.cameras_json import camera_names
from .scene.gps import scale_by_gps
from .scene.scale import Scale, scale_by_length
from .splatting.subject.extent import longest_side
from .training import RunLog

LEAST_PROBABILITY = 0.5
"""Probability from which a Gaussian belongs to the measured object."""


def add_scale(made: Reconstruction, encoder: Encoder, asked: UnitsConfig, log: RunLog) -> Reconstruction:
    """Return `made` with its scale, in the scene and in the origin, if there is one.

    An earlier result keeps its scale if the settings give no new one.

    Raises:
        SceneError: what is to be measured is not in the scene, or two cameras stand in one place.
        EncoderError: the features were made by another encoder.
        VocabularyError: the encoder does not know the object's word.
    """
    units = made.config.units if asked == UnitsConfig() else asked
    if made.scene.metres_per_unit is not None and units == made.config.units:
        return made
    with log.time_stage("scale"):
        scale = _measure(made, encoder, units, log)
    origin = {key: value for key, value in made.origin.items() if key != "scale"}
    return dataclasses.replace(
        made,
        scene=dataclasses.replace(made.scene, metres_per_unit=None if scale is None else scale.metres_per_unit),
        config=dataclasses.replace(made.config, units=units),
        origin=origin if scale is None else {**origin, "scale": dataclasses.asdict(scale)},
    )


def _measure(made: Reconstruction, encoder: Encoder, units: UnitsConfig, log: RunLog) -> Scale | None:
    scene = made.scene
    scale = scale_by_length(units, camera_names(made.files.cameras), scene.cameras)
    if scale is None and units.object is not None and units.length is not None:
        return _scale_by_object(made, encoder, units.object, units.length)
    if scale is None and units.gps and scene.images:
        found = scale_by_gps(scene.cameras, scene.images)
        log.notices += found.notices
        return found.scale
    return scale


def _scale_by_object(made: Reconstruction, encoder: Encoder, word: str, length: float) -> Scale:
    """The scale from the longest side, of `length` metres, of the largest object that matches the word.

    Raises:
        SceneError: there is none.
    """
    probability = relevancy(made.features, encoder, [word])
    fits = probability >= LEAST_PROBABILITY
    side = longest_side(made.gaussians.select(fits), made.features.weights.amax(1)[fits].numpy())
    if side is None:
        raise SceneError(
            f"--units.object: the scene has no {word} to measure: {int(fits.sum())} Gaussians are one with probability "
            f"{LEAST_PROBABILITY} or more, and the highest probability is {float(probability.max()):.2f}. "
            "Measure something else"
        )
    return Scale(
        metres_per_unit=length / side,
        measure="object",
        of=f"{length:g} m, the longest side of the largest {word}, {side:.4g} units",
    )
