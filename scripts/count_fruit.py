"""Count the fruit of one tree, headless.

    python scripts/count_fruit.py SCENE --prompt apple --out DIR
    blender -b --factory-startup --python-exit-code 1 -P scripts/count_fruit.py -- SCENE --prompt apple --out DIR

Exit code 0: counted, also if the count is 0; 1: not counted, with one line that says why; 2: usage; 130: cancelled.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401

from _help import parse_arguments
from _terminal import arguments_of, import_tyro, list_given_settings, preset_of, run, spell_out, terminal_progress
from fruitlangs.engine.config import (
    PRESETS,
    Config,
    CountConfig,
    EmbedConfig,
    PhotosConfig,
    Preset,
    SceneConfig,
    TrainConfig,
    UnitsConfig,
)
from fruitlangs.engine.errors import ConfigError

if TYPE_CHECKING:
    import tyro

    from fruitlangs.engine.pipeline import Result, Writer
else:
    tyro = import_tyro()


EXAMPLE = "photos/tree7 --prompt apple --out results/tree7"


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Count the fruit of one tree from photos or a video, and write every fruit as a labelled object."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Folder of photos, of a COLMAP model with images, of a nerfstudio transforms.json or of an earlier result; or a
    video, or a .ply of 3DGS Gaussians or coloured points."""
    prompt: tuple[str, ...]
    """What to count, for example apple or "red apple". With several prompts, a fruit must match one of them."""
    out: Path
    """Folder for the results; earlier results in it are replaced when the new ones are complete."""
    negative: tuple[str, ...] = ()
    """What to exclude, in addition to leaves, branches, sky and other built-in negatives."""
    gaussians: Path | None = None
    """A .ply of 3DGS Gaussians or coloured points in the frame of SCENE's cameras; replaces training."""
    preset: Preset = "standard"
    """Training settings to start from: quick for a preview, standard, or paper with 30,000 steps."""
    blend: bool = True
    """Also write scene.blend; needs Blender or the bpy module."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    photos: PhotosConfig = field(default_factory=PhotosConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    embed: EmbedConfig = field(default_factory=EmbedConfig)
    count: CountConfig = field(default_factory=CountConfig)
    units: UnitsConfig = field(default_factory=UnitsConfig)


def blend_writer(wanted: bool) -> dict[str, Writer]:
    """The writer of scene.blend if bpy can be imported; checked now, not at the end of a long run."""
    if not wanted:
        return {}
    try:
        from fruitlangs.operators.data.write import write_blend
        from fruitlangs.operators.data.write_gaussians import join_asked_words
        from fruitlangs.operators.settings.panel_state import panel_state
        from fruitlangs.operators.settings.settings import make_relative_path
    except ImportError as error:
        print(
            f"scene.blend is not written: bpy cannot be imported ({error}). Run: pip install bpy",
            file=sys.stderr,
        )
        return {}

    def write(path: Path, result: Result) -> None:
        write_blend(
            path,
            result.scene,
            result.gaussians,
            result.probability,
            result.fruit_count,
            asked=join_asked_words(result.origin["prompts"], result.origin["negatives"]),
            set_id=result.set_id,
            threshold=result.config.count.threshold,
            folder=result.out,
            panel=panel_state(result, partial(make_relative_path, folder=result.out.absolute())),
        )

    return {"scene.blend": write}


def main() -> None:
    arguments, given = parse()
    if not arguments.prompt:
        raise ConfigError('No prompt is given. Add what to count, for example --prompt apple or --prompt "red apple".')
    from fruitlangs.engine.pipeline import count_scene
    from fruitlangs.engine.report.tables import summary
    from fruitlangs.engine.report.words import scale_text, training_text

    result = count_scene(
        arguments.source,
        arguments.prompt,
        arguments.out,
        negatives=arguments.negative,
        config=Config(
            scene=arguments.scene,
            photos=arguments.photos,
            train=arguments.train,
            embed=arguments.embed,
            count=arguments.count,
            units=arguments.units,
        ),
        imported=arguments.gaussians,
        given=given,
        writers=blend_writer(arguments.blend),
        progress=terminal_progress(),
    )
    text = summary(
        result.fruit_count,
        prompt=" or ".join(arguments.prompt),
        threshold=arguments.count.threshold,
        metres_per_unit=result.scene.metres_per_unit,
        seconds=result.seconds,
    )
    print(text)
    if "scale" in result.origin:
        print(f"  {scale_text(result.origin['scale'])}")
    training = result.origin["training"]
    if training["psnr"] is not None:
        quality = f"PSNR {training['psnr']:.2f} dB, SSIM {training['ssim']:.3f}"
        print(f"  held-out photos: {quality}{training_text(training)}")
    if result.reused:
        print(f"  reused from an earlier run: {', '.join(result.reused)}")
    for notice in result.notices:
        print(f"  note: {notice}")
    print("\nwritten:")
    for path in result.files:
        print(f"  {path}")


def parse() -> tuple[Arguments, set[str]]:
    """The arguments and the names of the settings among them, or exit 2 with a usage message."""
    given = spell_out(arguments_of(__file__), "embed", EmbedConfig)
    preset = preset_of(given)
    needed: Any = tyro.MISSING
    default = Arguments(source=needed, prompt=needed, out=needed, preset=preset, train=PRESETS[preset])
    return parse_arguments(Arguments, default, given, __file__, EXAMPLE), list_given_settings(given)


if __name__ == "__main__":
    run(main)
