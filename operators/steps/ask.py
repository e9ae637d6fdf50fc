"""Computes the probability of the prompt for all Gaussians while the prompt is edited.

A thread computes the answer from the features in the result folder; the main thread writes it. The mesh stores the
words of its probabilities (`ASKED`), so that undo, redo and another file are detected and the answer is computed again.
"""

from __future__ import annotations

import os
import threading
from collections import ChainMap
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from bpy.app.handlers import persistent
from numpy.typing import NDArray

from ...engine.errors import FruitLangsError, OutputError, SceneError
from ..blender_data import find_owned_object, read_gaussian_attributes, set_attribute, to_array
from ..data.write_gaussians import ASKED, join_asked_words
from ..jobs.jobs import describe_error, is_linked, redraw_sidebars
from ..jobs.preload import preload_libraries
from ..jobs.target_scene import find_scene
from ..settings.lesson import LessonText, read_lesson
from ..settings.settings import read_config, read_prompts, read_words, resolve_stored_file
from ..viewport.appearance import apply_appearance, apply_changed_appearance
from ..viewport.viewport import has_window, redraw_viewports

if TYPE_CHECKING:
    from ...engine.config import CountConfig, EmbedConfig
    from ...engine.language.encoders.encoder import Encoder
    from ...engine.language.features.embedder import Embedder
    from ...engine.language.features.features import Features
    from ...engine.language.taught.word import TaughtWord
    from ...engine.language.teaching.region import Ground

PAUSE = 0.15
"""Seconds after the last edit before the answer is computed."""
LOOK_AGAIN = 0.05
"""Seconds between two checks for an answer."""


@dataclass(frozen=True)
class Question:
    """The prompt and the features, as plain values for a thread.

    scene: Blender's session uid; select: how Gaussians are selected; everything else of counting has its defaults;
    lesson: the word that is taught in the scene, None if there is none.
    """

    scene: int
    prompts: tuple[str, ...]
    negatives: tuple[str, ...]
    features: Path
    embed: EmbedConfig
    select: CountConfig
    lesson: LessonText | None = None

    @property
    def words(self) -> str:
        """The text that the mesh stores about it."""
        words = join_asked_words(self.prompts, self.negatives)
        return words if self.lesson is None else f"{words} | {self.lesson.name} {self.lesson.mark}"


class Worker(threading.Thread):
    """A thread that answers one question; `answer` (N,) or `error` is set when it has ended."""

    def __init__(self, question: Question, means: NDArray[np.float32]) -> None:
        super().__init__(name="fruitlangs ask", daemon=True)
        self.question = question
        self.answer: NDArray[np.float32] | None = None
        self.error: BaseException | None = None
        self._means = means

    def run(self) -> None:
        try:
            preload_libraries()
            self.answer = answer(self.question, self._means)
        except BaseException as error:  # any error: the main thread reports it
            self.error = error


# Threads cannot be stored in a .blend: the running one, and the Blender scenes that wait for an answer.
_worker: Worker | None = None
_waiting: set[int] = set()


def answer(question: Question, means: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) probability of the question for Gaussians at means (N, 3).

    Raises:
        OutputError: the features are gone, or of other Gaussians.
        FruitLangsError: the words or the encoder cannot be used.
    """
    import torch

    from ...engine.language.prompts.selection import select

    encoder = _open_encoder(question)
    if question.lesson is not None:
        word = learn_word(question, means)
        words: ChainMap[str, TaughtWord] = ChainMap({word.name: word}, encoder.taught)  # type: ignore[arg-type]
        encoder = encoder.with_words(words)
    features = _load_checked_features(question, means)
    places = torch.from_numpy(np.array(means))
    return to_array(select(features, encoder, question.prompts, question.negatives, question.select, places))


def learn_word(question: Question, means: NDArray[np.float32]) -> TaughtWord:
    """Learn the word of the question's lesson.

    Raises:
        OutputError: the features are gone, or of other Gaussians.
        FruitLangsError: the word or its examples cannot be used.
    """
    from ...engine.language.teaching.lesson import Lesson, Mark

    assert question.lesson is not None
    encoder = _open_encoder(question)
    features = _load_checked_features(question, means)
    ground = _make_ground(question.features, os.stat(question.features).st_mtime_ns, np.array(means).tobytes())
    lesson = Lesson(question.lesson.name, ground, features, encoder)
    places = [(positive, np.array(place)) for positive, place in question.lesson.places]
    marks = [
        Mark(positive, f"example {number}", ground.grow_region(place))
        for number, (positive, place) in enumerate(places, start=1)
    ]
    return lesson.word(marks)


def _load_checked_features(question: Question, means: NDArray[np.float32]) -> Features:
    """Load the features of the question, checked to be those of Gaussians at means (N, 3)."""
    import torch

    try:
        features = _load_features(question.features, os.stat(question.features).st_mtime_ns)
    except OSError as error:
        raise OutputError(
            f"The features in {question.features} are missing. Press Reconstruct to create them again"
        ) from error
    if not features.are_of(torch.from_numpy(np.array(means))):
        raise OutputError(
            f"{question.features} has features of other Gaussians than those shown: a later run replaced it, or these "
            "were edited. Press Reconstruct or count again"
        )
    return features


def list_words_on_disk(config: EmbedConfig) -> tuple[tuple[str, int], ...]:
    """List names and times of the files of taught words, which other programs may change."""
    from ...engine.language.encoders.open_encoder import folder_of_words
    from ...engine.language.taught.word import SUFFIX

    with suppress(OSError):
        return tuple(
            sorted((file.name, file.stat().st_mtime_ns) for file in folder_of_words(config).glob(f"*{SUFFIX}"))
        )
    return ()


def _open_encoder(question: Question) -> Encoder:
    """Open the encoder of the question, with the taught words that are on the disk now."""
    return _open_embedder(question.embed, list_words_on_disk(question.embed)).encoder


@lru_cache(maxsize=1)
def _open_embedder(config: EmbedConfig, _words: tuple[tuple[str, int], ...]) -> Embedder:
    from ...engine.language.features.embedder import Embedder

    return Embedder.open(config)


@lru_cache(maxsize=1)
def _make_ground(path: Path, changed: int, means: bytes) -> Ground:
    """Return the Gaussians at means, (N, 3) float32 as bytes, with their features, ready for clicks."""
    import torch

    from ...engine.language.teaching.region import Ground

    places = torch.frombuffer(bytearray(means), dtype=torch.float32).reshape(-1, 3)
    return Ground.of(places, _load_features(path, changed))


@lru_cache(maxsize=1)
def _load_features(path: Path, _changed: int) -> Features:
    from ...engine.language.features.features import load_features

    return load_features(path)


def question_of(bpy_scene: bpy.types.Scene) -> Question:
    """The question of this Blender scene's panel.

    Raises:
        SceneError: nothing is reconstructed yet, or its Gaussians are being edited.
        FruitLangsError: no prompt, or a setting makes no sense.
    """
    settings, item = bpy_scene.fruitlangs, find_owned_object(bpy_scene, "gaussians")
    if item is None or not settings.result.features:
        raise SceneError("There are no Gaussians yet. Press Reconstruct, or import a result")
    if item.mode == "EDIT":
        raise SceneError("The Gaussians are in Edit Mode. Leave it (Tab) and try again")
    from ...engine.config import CountConfig

    config = read_config(settings)
    chosen = {name: getattr(config.count, name) for name in ("select", "tau_pos", "tau_neg", "neighbours")}
    return Question(
        scene=bpy_scene.session_uid,
        prompts=tuple(read_prompts(settings)),
        negatives=tuple(read_words(settings.negative)),
        features=resolve_stored_file(settings.result.features),
        embed=config.embed,
        select=CountConfig(**chosen),
        lesson=read_lesson(settings),
    )


def answer_changed_words(settings: Any, _context: Any = None) -> None:
    """Called when the prompt or the negatives were edited: answer soon, and report an unknown word at once."""
    if settings.id_data.library is None and has_window():
        ask_soon(settings.id_data)


def ask_soon(bpy_scene: bpy.types.Scene) -> None:
    """Answer when the user pauses; only in a window, where timers run."""
    _waiting.add(bpy_scene.session_uid)
    if bpy.app.timers.is_registered(_attend):
        bpy.app.timers.unregister(_attend)
    bpy.app.timers.register(_attend, first_interval=PAUSE)


def stop_asking() -> None:
    """Forget all questions and what answers need; called when the extension is disabled."""
    _waiting.clear()
    _open_embedder.cache_clear()
    _load_features.cache_clear()
    _make_ground.cache_clear()
    if bpy.app.timers.is_registered(_attend):
        bpy.app.timers.unregister(_attend)


def _attend() -> float | None:
    """The timer: take a finished answer, start the next question; None when all are answered."""
    global _worker
    if _worker is not None:
        if _worker.is_alive():
            return LOOK_AGAIN
        ended, _worker = _worker, None
        _show(ended)
    for bpy_scene in _iterate_waiting_scenes():
        _worker = _ask(bpy_scene)
        if _worker is not None:
            return LOOK_AGAIN
    return None


def _iterate_waiting_scenes() -> Iterator[bpy.types.Scene]:
    """Yield every waiting Blender scene, each once."""
    for bpy_scene in bpy.data.scenes:
        if bpy_scene.session_uid in _waiting:
            _waiting.discard(bpy_scene.session_uid)
            yield bpy_scene
    _waiting.clear()


def _ask(bpy_scene: bpy.types.Scene) -> Worker | None:
    """Start to answer; None if there is nothing to answer, which is no error while the user still enters settings, or
    if the words are answered already."""
    item = find_owned_object(bpy_scene, "gaussians")
    if item is None:
        return None
    try:
        question = question_of(bpy_scene)
        if item.data.get(ASKED) == question.words:
            show_answer_text(bpy_scene)
            return None
        worker = Worker(question, means_of(bpy_scene))
    except FruitLangsError as error:
        _tell(bpy_scene, str(error))
        return None
    worker.start()
    return worker


def means_of(bpy_scene: bpy.types.Scene) -> NDArray[np.float32]:
    item = find_owned_object(bpy_scene, "gaussians")
    assert item is not None
    means = np.empty(3 * len(item.data.vertices), np.float32)
    item.data.attributes["position"].data.foreach_get("vector", means)
    return means.reshape(-1, 3)


def _show(worker: Worker) -> None:
    """Write an answer into its scene, unless the words, the scene or its Gaussians have changed."""
    bpy_scene = find_scene(worker.question.scene)
    if bpy_scene is None:
        return
    if worker.answer is None:
        _tell(bpy_scene, describe_error(worker.error or RuntimeError("no answer")))
        return
    try:
        current = question_of(bpy_scene)
    except FruitLangsError as error:
        _tell(bpy_scene, str(error))
        return
    if current != worker.question:
        _waiting.add(bpy_scene.session_uid)
        return
    show_answer(bpy_scene, worker.answer, worker.question.words)


def show_answer(bpy_scene: bpy.types.Scene, probability: NDArray[np.float32], words: str) -> None:
    """Write probabilities (N,) of the words into the Gaussians and show how many match."""
    item = find_owned_object(bpy_scene, "gaussians")
    if item is None or len(item.data.vertices) != len(probability):
        return
    set_attribute(item.data, "probability", "FLOAT", probability)
    item.data.update()
    item.data[ASKED] = words
    apply_appearance(bpy_scene)
    show_answer_text(bpy_scene)
    redraw_viewports()


def show_answer_text(bpy_scene: bpy.types.Scene) -> None:
    """Show in the panel how many Gaussians reach the threshold; nothing before any answer."""
    settings, item = bpy_scene.fruitlangs, find_owned_object(bpy_scene, "gaussians")
    found = read_gaussian_attributes(bpy_scene, "probability")
    if item is None or found is None or not item.data.get(ASKED):
        return
    probability = found[0]
    fit, highest = int((probability >= settings.config.count.threshold).sum()), float(probability.max(initial=0.0))
    settings.answer.problem = ""
    settings.answer.text = f"{fit:,} of {len(probability):,} Gaussians match; highest probability {highest:.2f}"


def apply_threshold(settings: Any, _context: Any = None) -> None:
    """Called when the threshold was edited."""
    show_answer_text(settings.id_data)
    apply_changed_appearance(settings)


def _tell(bpy_scene: bpy.types.Scene, problem: str) -> None:
    """Show in the panel why there is no answer; the highlight stays."""
    bpy_scene.fruitlangs.answer.problem = problem
    redraw_sidebars(bpy.context)


@persistent
def ask_where_words_differ(_file: Any = None, _unused: Any = None) -> None:
    """After undo, redo and loading: answer again for every scene whose highlight belongs to other words than its
    panel."""
    for bpy_scene in bpy.data.scenes:
        item = find_owned_object(bpy_scene, "gaussians")
        if item is None or not has_window():
            continue
        try:
            if item.data.get(ASKED) != question_of(bpy_scene).words:
                ask_soon(bpy_scene)
        except FruitLangsError:
            continue


HANDLERS = ("undo_post", "redo_post", "load_post")


def register_handlers() -> None:
    """Watch undo, redo and loading."""
    for name in HANDLERS:
        getattr(bpy.app.handlers, name).append(ask_where_words_differ)


def unregister_handlers() -> None:
    """Take back what `register_handlers` added."""
    stop_asking()
    for name in HANDLERS:
        handlers = getattr(bpy.app.handlers, name)
        if ask_where_words_differ in handlers:
            handlers.remove(ask_where_words_differ)


def suggest_prompts(settings: Any, _context: Any, typed: str) -> list[str]:
    """Suggest completions of a prompt: taught words, the nouns of the vocabulary, and colours and ripeness before
    fruit."""
    from ...engine.config import EmbedConfig
    from ...engine.language.taught.library import is_word_file, name_of
    from ...engine.language.vocabulary import CONCEPTS, FRUIT_COLOURS, FRUITS, GENERAL

    before, _, last = typed.rpartition(",")
    begun = last.strip().casefold()
    kept = f"{before.strip()}, " if before.strip() else ""
    embed = EmbedConfig() if settings is None else read_config(settings).embed
    taught = [name_of(file) for file, _ in list_words_on_disk(embed) if is_word_file(file)]
    things = dict.fromkeys([*taught, "fruit", *CONCEPTS, *(word for word in GENERAL if word != "fruit")])
    fruits = dict.fromkeys(["fruit", *FRUITS, *taught])
    described = [f"{word} {fruit}" for fruit in fruits for word in ("ripe", "unripe", *FRUIT_COLOURS)]
    fitting = [word for word in [*things, *described] if begun in word]
    return [kept + word for word in sorted(fitting, key=lambda word: not word.startswith(begun))]


def has_gaussians(operator: Any, context: bpy.types.Context) -> bool:
    """Whether there are Gaussians to ask; the operator's poll shows that there are none as the reason."""
    if context.scene is not None and find_owned_object(context.scene, "gaussians") is not None:
        return True
    operator.poll_message_set("There are no Gaussians yet. Press Reconstruct, or import a result")
    return False


class FRUITLANGS_OT_ask(bpy.types.Operator):
    bl_idname = "fruitlangs.ask"
    bl_label = "Match Prompt"
    bl_description = (
        "Compute the probability of the prompt for each Gaussian; runs automatically when the prompt changes"
    )
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not is_linked(cls, context) and has_gaussians(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        if has_window():  # loading the features would interrupt typing
            item = find_owned_object(context.scene, "gaussians")
            assert item is not None
            item.data[ASKED] = ""
            ask_soon(context.scene)
            return {"FINISHED"}
        try:
            question = question_of(context.scene)
            show_answer(context.scene, answer(question, means_of(context.scene)), question.words)
        except Exception as error:
            message = describe_error(error)
            _tell(context.scene, message)
            self.report({"ERROR"}, message)
            return {"CANCELLED"}
        problem = context.scene.fruitlangs.answer.problem
        self.report({"WARNING"} if problem else {"INFO"}, problem or context.scene.fruitlangs.answer.text)
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_ask,)
