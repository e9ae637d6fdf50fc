"""The whole pipeline: photos → cameras → Gaussians → features → probability → fruits → files.

The command line and Blender's operators call `count_scene`. Training and lifting are cached in `OUT/cache/` under the
hash of their inputs, settings and code (`reconstruction`), so a second prompt reuses them. The files of a result are
written to a staging folder and moved into place at the end (`publishing`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from .compile_ahead import compiled_ahead
from .config import Config
from .counting.accounts.ids import NO_FRUIT, KnownFruit
from .counting.count import count_fruit
from .counting.published.template_shape import read_template
from .errors import OutputError, VocabularyError
from .files import file_hash, require_writable
from .language.features.embedder import Embedder
from .language.prompts.relevancy import check_prompts
from .language.prompts.selection import select
from .language.vocabulary import parse
from .progress import Progress, part, silent
from .publishing import Result, Writer, publish
from .reconstruction import Reconstruction, Stages, adopt, check_imported, reconstruct, reopen
from .report.results import FRUITS_JSON, known_fruit
from .scale import scaled
from .splatting.training.train import Watch


def count_scene(
    source: Path,
    prompts: Sequence[str],
    out: Path,
    *,
    negatives: Sequence[str] = (),
    config: Config = Config(),  # noqa: B008 (frozen)
    writers: Mapping[str, Writer] | None = None,
    keep: Path | None = None,
    imported: Path | None = None,
    watch: Watch | None = None,
    progress: Progress = silent,
) -> Result:
    """Count the fruit that `prompts` name in the scene at `source` and write the result folder `out`.

    Args:
        source: a COLMAP model with its images, a transforms.json or its folder, a folder of photos alone, an earlier
            result folder, or a `.ply` of Gaussians or coloured points, around which cameras are placed.
        prompts: what to count; a fruit must match one of them.
        negatives: what to exclude, in addition to built-in negatives.
        writers: more files to write, by name; `scene.blend` comes from the caller, as the engine never imports bpy.
        keep: a file that stays although it belongs to the earlier result, such as the open .blend.
        imported: a `.ply` of Gaussians or coloured points in the frame of the scene's cameras; nothing is trained then.
        watch: receives the Gaussians during training.

    Raises:
        OutputError: among others, `out` is the folder of the photos: it would look like a result from then on.
        FruitLangsError: an error that the user can act on; earlier results in `out` stay unchanged.
        Cancelled: `progress` asked for it; finished stages and the last checkpoint stay in `out/cache`.
    """
    embedder = Embedder.open(config.embed)
    encoder = embedder.encoder
    check_prompts(encoder, prompts, negatives)  # an unknown word must not cost a training run
    given: dict[str, str] = {}
    if config.count.template:
        read_template(Path(config.count.template))  # nor must an invalid template
        given["template_sha256"] = file_hash(Path(config.count.template))
    stages = Stages()
    made = _made(source, out, embedder, config, imported, watch, stages, part(progress, 0.0, 0.9))
    known = _known(made, source, out)
    with stages.timed("count"):
        probability = select(made.features, encoder, prompts, negatives, config.count, made.gaussians.means)
        fruit_count = count_fruit(
            made.gaussians,
            probability,
            made.scene.cameras,
            config.count,
            label=_label(prompts),
            known=known,
            up=made.scene.up,
            progress=part(progress, 0.9, 0.97),
        )
    result = Result(
        scene=made.scene,
        gaussians=made.gaussians,
        features=made.features,
        probability=probability,
        fruit_count=fruit_count,
        known=known,
        origin={**made.origin, "prompts": list(prompts), "negatives": list(negatives), **given},
        config=made.config,
        seconds=stages.seconds,
        reused=stages.reused,
        notices=[*stages.notices, *fruit_count.notices],
        out=out,
    )
    progress(0.97, "Writing results")
    result = publish(result, made, writers or {}, keep, stages)
    progress(1.0, "Done")
    return result


def reconstruct_scene(
    source: Path,
    out: Path,
    *,
    config: Config = Config(),  # noqa: B008 (frozen)
    imported: Path | None = None,
    watch: Watch | None = None,
    progress: Progress = silent,
) -> tuple[Reconstruction, Stages]:
    """What `count_scene` makes of the scene at `source` before it uses a prompt, cached in `out`/cache.

    Returns it with the log of the run. Arguments and errors as of `count_scene`.
    """
    stages = Stages()
    made = _made(source, out, Embedder.open(config.embed), config, imported, watch, stages, progress)
    progress(1.0, "Done")
    return made, stages


def _made(
    source: Path,
    out: Path,
    embedder: Embedder,
    config: Config,
    imported: Path | None,
    watch: Watch | None,
    stages: Stages,
    progress: Progress,
) -> Reconstruction:
    """Everything that does not depend on the prompt, by the method that suits `source`, with its scale."""
    if config.units.object is not None:
        check_prompts(embedder.encoder, [config.units.object])
    if imported is not None:
        check_imported(source, imported, out)
    with compiled_ahead(progress, 1.0):
        if (source / FRUITS_JSON).is_file():
            made = reopen(source, out, embedder, config, stages)
            require_writable(out / "cache")
        elif out.resolve() == (source.parent if source.is_file() else source).resolve():
            raise OutputError(f"{out} is the folder of the scene itself. Choose another folder for the results")
        elif imported is not None or source.suffix.lower() == ".ply":
            made = adopt(source, imported, out / "cache", embedder, config, stages, progress)
        else:
            made = reconstruct(source, out / "cache", embedder, config, stages, progress, watch)
    return scaled(made, embedder.encoder, config.units, stages)


def _known(made: Reconstruction, source: Path, out: Path) -> KnownFruit:
    """Fruit that were numbered before in this scene: from `out`, else from the result that is counted again."""
    inputs = made.origin["inputs_sha256"]
    return next((known for folder in (out, source) if (known := known_fruit(folder, inputs)).last), NO_FRUIT)


def _label(prompts: Sequence[str]) -> str:
    """The label of the counted fruit: "Apples" → "apple"; several prompts are joined."""
    return " or ".join(dict.fromkeys(_name(prompt) for prompt in prompts))


def _name(prompt: str) -> str:
    """A prompt as in the vocabulary; unchanged if only CLIP knows the word."""
    try:
        return parse(prompt).text
    except VocabularyError:
        return " ".join(prompt.casefold().split())
