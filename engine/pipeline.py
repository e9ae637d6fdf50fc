"""The whole pipeline: photos → cameras → Gaussians → features → probability → fruits → files.

The command line and Blender's operators call `count_scene`. Training and lifting are cached in `OUT/cache/` under the
hash of their inputs, settings and code (`reconstruction`), so a second prompt reuses them. The files of a result are
replaced together at the end (`result_folder`), and one run at a time writes to a folder.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from .compile_ahead import compile_alongside
from .config import Config
from .counting.accounts.ids import NO_FRUIT, KnownFruit
from .counting.accounts.zero import Quality
from .counting.fruit import FruitCount
from .counting.photos.verifier import require_trained_for
from .counting.prompted import Searched, count_prompts
from .counting.published.template_shape import read_template
from .errors import ConfigError, FruitLangsError, OutputError
from .language.encoders.encoder import sees_fruit
from .language.features.embedder import Embedder
from .language.prompts.relevancy import check_prompts, taught_words
from .language.prompts.selection import select
from .photo_size import width_notices
from .progress import Progress, part, silent
from .publishing import Result, Writer, publish
from .reconstruction import Reconstruction, add_fitting_photos, reconstruct, reopen
from .report.results import parse_known_fruit
from .result_folder import ResultFolder
from .scale import add_scale
from .scene.source import Source
from .splatting.rendering.device import DrawingCard, use_card
from .splatting.training.card_step import adapter_for
from .splatting.training.train import Watch
from .storage.files import file_hash
from .training import Run, RunLog

CLUMPED = 0.5
"""Share of the fruit of a taught word that touch others, above which a message says that bunches are not counted."""


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
    given: Collection[str] | None = None,
    watch: Watch | None = None,
    progress: Progress = silent,
) -> Result:
    """Count the fruit that `prompts` name in the scene at `source` and write the result folder `out`.

    Parameters
    ----------
    source : Path
        A COLMAP model with its images, a transforms.json or its folder, a folder of photos alone, a video, an earlier
        result folder, or a `.ply` of Gaussians or colored points, around which cameras are placed.
    prompts : sequence of str
        What to count; a fruit must match one of them.
    out : Path
        Folder of the result. An earlier result in it is replaced when the new one is complete.
    negatives : sequence of str
        What to exclude, in addition to built-in negatives.
    config : Config
        The settings of all stages.
    writers : mapping of str to callable, optional
        More files to write, by name; `scene.blend` comes from the caller, as the engine never imports bpy.
    keep : Path, optional
        A file that stays although it belongs to the earlier result, such as the open .blend.
    imported : Path, optional
        A `.ply` of Gaussians or colored points in the frame of the scene's cameras; nothing is trained then.
    given : collection of str, optional
        The settings ("train.steps") that the user gave; by default those that differ from their defaults. An earlier
        result must have been made with them.
    watch : callable, optional
        Receives the Gaussians during training.
    progress : callable
        Receives the fraction done, in [0, 1], and what is done; raises `Cancelled` to stop.

    Returns
    -------
    Result
        The fruit, with everything that they were found from.

    Raises
    ------
    OutputError
        Among others, another run writes to `out`, or `out` is the folder of the photos: it would look like a result
        from then on.
    GpuError
        The graphics card that was asked for is not there.
    FruitLangsError
        An error that the user can act on; earlier results in `out` stay unchanged.
    Cancelled
        `progress` asked for it; finished stages and the last checkpoint stay in `out/cache`.

    Examples
    --------
    >>> result = fruitlangs.count_scene(Path("photos/tree7"), ["red apple"], Path("results/tree7"))
    >>> result.fruit_count.count, result.fruit_count.interval
    (118, (112, 131))
    """
    embedder = Embedder.open(config.embed)
    encoder = embedder.encoder
    check_prompts(encoder, prompts, negatives)  # an unknown word must not cost a training run
    words = taught_words(encoder, [*prompts, *negatives])
    if sees_fruit(encoder):
        require_trained_for(encoder.fruit_identity)
    template: dict[str, str] = {}
    if config.count.template:
        read_template(Path(config.count.template))  # nor must an invalid template
        template["template_sha256"] = file_hash(Path(config.count.template))
    folder = ResultFolder(out)
    run = Run(folder.cache, embedder, config, given, watch, *adapter_for(config.train, joint=embedder.trains))
    opened = _open(source, imported, out, progress)
    with folder.lock(), use_card(run.adapter) as card:
        made = _prepare(opened, imported, run, part(progress, 0.0, 0.9))
        known = _find_known(made, source, out)
        with run.log.time_stage("count"):
            probability = select(made.features, encoder, prompts, negatives, config.count, made.gaussians.means)
            searched = Searched(
                scene=made.scene,
                gaussians=made.gaussians,
                features=made.features,
                photos=made.photos,
                encoder=encoder,
                config=config.count,
                quality=Quality.of(made.origin["training"]),
            )
            fruit_count = count_prompts(
                searched, prompts, negatives, probability, known=known, progress=part(progress, 0.9, 0.97)
            )
        result = Result(
            scene=made.scene,
            gaussians=made.gaussians,
            features=made.features,
            probability=probability,
            fruit_count=fruit_count,
            known=known,
            origin={**made.origin, "prompts": list(prompts), "negatives": list(negatives), **words, **template},
            config=made.config,
            seconds=run.log.seconds,
            reused=run.log.reused,
            notices=[
                *run.log.notices,
                *fruit_count.notices,
                *_note_narrow(fruit_count, made),
                *note_clumped(fruit_count, words),
                *_note_drawing_problem(card),
            ],
            out=out,
        )
        progress(0.97, "Writing results")
        result = publish(result, made, writers or {}, keep, run.log)
    progress(1.0, "Done")
    return result


def reconstruct_scene(
    source: Path,
    out: Path,
    *,
    config: Config = Config(),  # noqa: B008 (frozen)
    imported: Path | None = None,
    given: Collection[str] | None = None,
    watch: Watch | None = None,
    progress: Progress = silent,
) -> tuple[Reconstruction, RunLog]:
    """Reconstruct the scene at `source` as Gaussians with features, and keep them in `out`/cache for later prompts.

    Parameters and errors are those of `count_scene`, which does the same before it uses a prompt.

    Returns
    -------
    reconstruction : Reconstruction
        Cameras, Gaussians and features.
    log : RunLog
        Seconds by stage, reused stages and notices.

    Examples
    --------
    >>> reconstruction, log = fruitlangs.reconstruct_scene(Path("photos/tree7"), Path("results/tree7"))
    >>> reconstruction.gaussians.means.shape
    torch.Size([70000, 3])
    """
    folder = ResultFolder(out)
    embedder = Embedder.open(config.embed)
    run = Run(folder.cache, embedder, config, given, watch, *adapter_for(config.train, joint=embedder.trains))
    opened = _open(source, imported, out, progress)
    with folder.lock(), use_card(run.adapter) as card:
        made = _prepare(opened, imported, run, progress)
    run.log.notices += _note_drawing_problem(card)
    progress(1.0, "Done")
    return made, run.log


def _open(path: Path, imported: Path | None, out: Path, progress: Progress) -> Source | ResultFolder:
    """Open what is counted: an earlier result, or a source whose model is read and sound, so that a wrong path makes no
    folder.

    Raises:
        SceneError: there is no scene, or it is damaged.
        OutputError: `out` is the folder of an input.
        ConfigError: Gaussians are given for a source that has its own.
    """
    earlier, alone = ResultFolder(path), path.suffix.lower() == ".ply"
    if imported is not None and (earlier.holds_result() or alone):
        raise ConfigError(f"{path} holds its own Gaussians. With --gaussians give the photos and cameras as SCENE")
    if imported is not None and imported.resolve().parent == out.resolve():
        raise OutputError(f"{out} is the folder of {imported.name} itself. Choose another folder for the results")
    if earlier.holds_result():
        return earlier
    if out.resolve() == (path.parent if path.is_file() else path).resolve():
        raise OutputError(f"{out} is the folder of the scene itself. Choose another folder for the results")
    source = Source(path=path)
    if not alone and (imported is not None or not source.is_alone()):
        source.open(part(progress, 0.0, 0.0))
    return source


def _prepare(opened: Source | ResultFolder, imported: Path | None, run: Run, progress: Progress) -> Reconstruction:
    """Prepare everything that does not depend on the prompt, with its scale."""
    encoder = run.embedder.encoder
    if run.config.units.object is not None:
        check_prompts(encoder, [run.config.units.object])
    with compile_alongside(progress, 1.0):
        if isinstance(opened, ResultFolder):
            with run.log.time_stage("scene"):
                document = opened.read()
            made = reopen(
                opened,
                document,
                run.config,
                run.log,
                cache=run.cache,
                given=run.config.list_changed() if run.given is None else run.given,
                encoder_id=encoder.identity,
            )
            made = add_fitting_photos(made, encoder, run.cache, run.log, progress)
        else:
            made = reconstruct(opened, imported, run, progress)
    return add_scale(made, encoder, run.config.units, run.log)


def _note_narrow(fruit_count: FruitCount, made: Reconstruction) -> list[str]:
    """Return a message if the photos that were trained on were scaled down until the fruit became too narrow."""
    if "imported" in made.origin:
        return []
    return width_notices(fruit_count.pixel_width, made.scene.images, made.scene.cameras, made.config)


def _note_drawing_problem(card: DrawingCard | None) -> list[str]:
    """Return a message if a graphics card did not draw all views."""
    return [f"the CPU drew views: {card.problem}"] if card is not None and card.problem else []


def note_clumped(fruit_count: FruitCount, taught: Mapping[str, object]) -> list[str]:
    """Return a message if most of the fruit of a taught word touch one another: the word may have been shown
    bunches."""
    touching = sum(fruit.kind == "compound-part" for fruit in fruit_count.fruits)
    if not taught or touching <= CLUMPED * fruit_count.count:
        return []
    return [f"{touching} of {fruit_count.count} fruit touch others and are counted one by one, not as bunches"]


def _find_known(made: Reconstruction, source: Path, out: Path) -> KnownFruit:
    """Find fruit that were numbered before in this scene: from `out`, else from the result that is counted again."""
    for folder in map(ResultFolder, (out, source)):
        with suppress(FruitLangsError):
            known = parse_known_fruit(folder.read(verify=False), made.origin["inputs_sha256"])
            if known.last:
                return known
    return NO_FRUIT
