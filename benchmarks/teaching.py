"""Words that are taught by a fixed rule of clicks in a generated scene, and the fruit that they find there and in
others of its species."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..engine.config import Config, EmbedConfig
from ..engine.errors import FormatError, FruitLangsError
from ..engine.evaluation.judgement import judge
from ..engine.evaluation.metrics import CountMetrics, count_metrics
from ..engine.evaluation.renders import read_instances
from ..engine.evaluation.truth import Truth, read_truth
from ..engine.language.encoders.encoder import Encoder
from ..engine.language.features.embedder import Embedder
from ..engine.language.prompts.relevancy import relevancy
from ..engine.language.taught.library import word_file
from ..engine.language.taught.word import TaughtWord, save_word
from ..engine.language.teaching.lesson import Lesson, Mark
from ..engine.language.teaching.photo_marks import Click, marks_of_clicks
from ..engine.language.teaching.region import Ground
from ..engine.language.vocabulary import CONCEPTS
from ..engine.pipeline import count_scene
from ..engine.progress import Progress, silent
from ..engine.publishing import Result
from ..engine.splatting.rendering.rasterize import render
from .counting.trials import metrics_of
from .ladder.stages import TRUE_POSES, measure_masked_probability
from .markdown import markdown
from .orchards import TRUTH, read_origin

BoolArray = NDArray[np.bool_]

APART = 1.0
"""Distance of negative clicks from all fruit, in typical diameters of the fruit in the photo: nearer to it Gaussians
show a part of it."""
ACCEPTED = 0.2
"""Share of fruit in the region of a negative click below which a user who sees it accepts it."""
BUILT_IN = "built-in"
"""Stands for the word that needs no clicks."""


@dataclass(frozen=True, kw_only=True)
class WordTrial:
    """A count with a word. species: what grows; scene: what was counted; taught: scene of the clicks, or BUILT_IN;
    positive, negative: numbers of clicks; seconds: of learning; metrics: at half a diameter."""

    species: str
    scene: str
    taught: str
    positive: int
    negative: int
    seconds: float
    metrics: CountMetrics

    @property
    def place(self) -> tuple[str, str, int, int]:
        """What tells it from others."""
        return self.scene, self.taught, self.positive, self.negative


@dataclass(frozen=True, eq=False)
class Tree:
    """A generated scene that was counted. fruit: (H, W) bool per view, where its true fruit is."""

    folder: Path
    species: str
    result: Result
    ground: Ground
    truth: Truth
    instances: Sequence[NDArray[np.uint16]]
    fruit: Sequence[BoolArray]

    @classmethod
    def grow(cls, folder: Path, out: Path, progress: Progress = silent) -> Tree:
        """Count the scene in `folder` with its own word, or as "fruit" if that is not built in. Cached as the
        stage with true poses of the ladder in the same `out`."""
        species = read_origin(folder).species
        word = species if species in CONCEPTS else "fruit"
        return cls.of(folder, count_scene(folder, [word], out / TRUE_POSES, progress=progress))

    @classmethod
    def of(cls, folder: Path, result: Result) -> Tree:
        """The scene in `folder` with its result.

        Raises:
            FormatError: its truth or its masks cannot be read.
        """
        species = read_origin(folder).species
        truth = read_truth(folder / TRUTH, {species})
        if truth.ids is None:
            raise FormatError(f"{folder / TRUTH} records no ids of fruit. Make the scene again")
        instances = read_instances(folder, result.scene)
        fruit = [np.isin(each, truth.ids) for each in instances]
        ground = Ground.of(result.gaussians.means, result.features)
        return cls(folder, species, result, ground, truth, instances, fruit)

    @cached_property
    def _encoder(self) -> Encoder:
        return Embedder.open(self.result.config.embed).encoder

    def lesson(self, name: str) -> Lesson:
        """To teach a word in this tree."""
        return Lesson(name, self.ground, self.result.features, self._encoder)

    def count_with(self, word: TaughtWord, folder: Path) -> Result:
        """Count the tree with a word that was taught, which is written to the folder next to the result."""
        save_word(word_file(folder, word.name), word)
        config = Config(embed=EmbedConfig(words=str(folder)))
        return count_scene(self.result.out, [word.name], folder / self.folder.name, config=config)

    def measure(self, result: Result) -> CountMetrics:
        """Measure a count of this tree against its truth."""
        return count_metrics(result.fruit_count.centers, result.fruit_count.diameters, self.truth)

    def choose_positive_clicks(self, number: int) -> list[Click]:
        """Choose clicks, each in the middle of another fruit, in the view that shows the largest part of it: an even
        selection of the fruit by that size, without the smaller half."""
        best: dict[int, tuple[int, int, int]] = {}
        for view, (ids, fruit) in enumerate(zip(self.instances, self.fruit, strict=True)):
            numbers, sizes = np.unique(ids[fruit], return_counts=True)
            for one, size in zip(numbers.tolist(), sizes.tolist(), strict=True):
                best[one] = max(best.get(one, (0, 0, 0)), (size, -view, one))
        ranked = sorted(best.values(), reverse=True)
        ranked = ranked[: max(number, len(ranked) // 2)]
        places = [(2 * turn + 1) * len(ranked) // (2 * number) for turn in range(number)]
        clicks = []
        for _, view, one in (ranked[place] for place in dict.fromkeys(places)):
            inside = ndimage.distance_transform_edt(np.pad(self.instances[-view] == one, 1))[1:-1, 1:-1]
            clicks.append(self._click(-view, np.unravel_index(int(inside.argmax()), inside.shape), positive=True))
        return clicks

    def choose_negative_marks(self, word: TaughtWord, number: int) -> list[Mark]:
        """Choose clicks where photos show no fruit and the word matches best: one a photo, none on what another one
        has, and none whose region a user would not accept, because it reaches over fruit."""
        probability = relevancy(self.result.features, self._encoder.with_words({word.name: word}), [word.name])
        found = []
        views = zip(self.result.scene.cameras, self.instances, self.fruit, strict=True)
        for view, (camera, ids, fruit) in enumerate(views):
            drawn = render(self.result.gaussians, camera, features=probability[:, None]).features
            assert drawn is not None
            shown = ndimage.uniform_filter(drawn[..., 0].detach().numpy(), 3)
            shown[ndimage.distance_transform_edt(~fruit) < APART * _measure_width(ids[fruit])] = -1.0
            place = np.unravel_index(int(shown.argmax()), shown.shape)
            found.append((-float(shown[place]), view, place))
        marks: list[Mark] = []
        taken = np.zeros(0, np.int64)
        for _, view, place in sorted(found):
            if len(marks) == number:
                break
            try:
                (mark,) = self.marks([self._click(view, place, positive=False)])
            except FruitLangsError:  # nothing was reconstructed there
                continue
            shows = float(self._shown[mark.rows].mean())
            if shows < ACCEPTED and not np.isin(mark.rows, taken).any():
                marks.append(mark)
                taken = np.concatenate([taken, mark.rows])
        return marks

    @cached_property
    def _shown(self) -> NDArray[np.float32]:
        """(M,) share of fruit in what each Gaussian of `ground` shows."""
        assert self.truth.ids is not None
        cameras = self.result.scene.cameras
        shown = measure_masked_probability(self.result.gaussians, cameras, self.instances, self.truth.ids)
        return shown.numpy()[self.ground.rows]

    def marks(self, clicks: Sequence[Click]) -> list[Mark]:
        return marks_of_clicks(clicks, self.result.scene, self.result.gaussians, self.ground)

    def _click(self, view: int, place: tuple[Any, ...], *, positive: bool) -> Click:
        row, column = (int(each) for each in place)
        return Click(positive, self.result.scene.images[view].name, column + 0.5, row + 0.5)

    def teach(self, name: str, positive: int, negative: int) -> tuple[TaughtWord, float]:
        """Return the word, and how long the last learning took, in seconds."""
        lesson, marks = self.lesson(name), self.marks(self.choose_positive_clicks(positive))
        if negative:
            marks += self.choose_negative_marks(lesson.word(marks), negative)
        start = time.perf_counter()
        word = lesson.word(marks)
        return word, time.perf_counter() - start


def _measure_width(numbers: NDArray[np.uint16]) -> float:
    """Measure the diameter in pixels of a disc as large as the typical fruit. numbers: ids of all pixels that show
    fruit."""
    sizes = np.unique(numbers, return_counts=True)[1]
    return float(2.0 * np.sqrt(np.median(sizes) / np.pi)) if len(sizes) else 0.0


def choose_name(species: str) -> str:
    """Choose the name under which a species is taught: not that of a built-in word, which would be refined, and without
    the colour orange, which no name may have."""
    if species == "orange":
        return "mandarin"
    return f"own {species}" if species in CONCEPTS else species


def try_words(
    trees: Sequence[Tree], lessons: Sequence[tuple[int, int]], out: Path, known: Sequence[WordTrial] = ()
) -> Iterator[WordTrial]:
    """Count trees of one species with their built-in word and with words that are taught in each of them.

    lessons: numbers of positive and of negative clicks; out: folder of words and results; known: trials that are not
    done again.
    """
    done = {trial.place: trial for trial in known}
    for tree in trees:
        built_in = _make_trial(tree, BUILT_IN, (0, 0), 0.0, tree.measure(tree.result))
        yield done.get(built_in.place, built_in)
    for teacher in trees:
        name = choose_name(teacher.species)
        for lesson in lessons:
            places = [(tree.folder.name, teacher.folder.name, *lesson) for tree in trees]
            if all(place in done for place in places):
                yield from (done[place] for place in places)
                continue
            word, seconds = teacher.teach(name, *lesson)
            for tree, place in zip(trees, places, strict=True):
                if place in done:
                    yield done[place]
                    continue
                counted = tree.count_with(word, out / teacher.folder.name / "{}+{}".format(*lesson))
                yield _make_trial(tree, teacher.folder.name, lesson, seconds, tree.measure(counted))


@dataclass(frozen=True, kw_only=True)
class Correction:
    """A false fruit of a built-in word, and what one click on it changes. fruit: its number; gone: nothing is counted
    there any more; false, true: false and true fruit before; false_after, true_after: and then."""

    scene: str
    fruit: int
    gone: bool
    false: int
    false_after: int
    true: int
    true_after: int


def correct(tree: Tree, out: Path, most: int = 3) -> list[Correction]:
    """Teach the built-in word of a tree that a false fruit is none, by that one example, and count again: each of the
    most probable false fruit in turn."""
    counted = tree.result.fruit_count
    before = judge(counted.centers, counted.diameters, tree.truth)
    false = [counted.fruits[place] for place in before.false.tolist()]
    lesson, corrections = tree.lesson(tree.species), list[Correction]()
    for wrong in sorted(false, key=lambda fruit: (-fruit.probability, fruit.id))[:most]:
        word = lesson.word([Mark(False, f"fruit {wrong.id}", tree.ground.grow_region(wrong.center))])
        result = tree.count_with(word, out / tree.folder.name / f"without {wrong.id}").fruit_count
        apart = np.linalg.norm(result.centers - wrong.center, axis=1)
        after = judge(result.centers, result.diameters, tree.truth)
        corrections.append(
            Correction(
                scene=tree.folder.name,
                fruit=wrong.id,
                gone=not bool((apart < wrong.diameter / 2.0).any()),
                false=len(before.false),
                false_after=len(after.false),
                true=len(before.pairs),
                true_after=len(after.pairs),
            )
        )
    return corrections


def corrections_table(corrections: Sequence[Correction]) -> str:
    """Markdown: one line per false fruit."""
    lines = [["scene", "false fruit", "after one click", "false, before and after", "true, before and after"]]
    for each in corrections:
        counts = f"{each.false}, {each.false_after}", f"{each.true}, {each.true_after}"
        lines.append([each.scene, str(each.fruit), "gone" if each.gone else "still there", *counts])
    return markdown(lines)


def _make_trial(tree: Tree, taught: str, lesson: tuple[int, int], seconds: float, metrics: CountMetrics) -> WordTrial:
    return WordTrial(
        species=tree.species,
        scene=tree.folder.name,
        taught=taught,
        positive=lesson[0],
        negative=lesson[1],
        seconds=seconds,
        metrics=metrics,
    )


def words_table(trials: Sequence[WordTrial]) -> str:
    """Markdown: F1 by species and numbers of clicks, in the scene of the clicks and in others, each a mean; the worst
    share of the built-in word's F1 in brackets."""
    lessons = sorted({(trial.positive, trial.negative) for trial in trials if trial.taught != BUILT_IN})
    head = ["species", "built-in"]
    for positive, negative in lessons:
        clicks = f"{positive}" if not negative else f"{positive} + {negative}"
        head += [f"{clicks}, same", f"{clicks}, other"]
    lines = [head]
    for species in dict.fromkeys(trial.species for trial in trials):
        own = [trial for trial in trials if trial.species == species]
        built_in = {trial.scene: trial.metrics.f1 for trial in own if trial.taught == BUILT_IN}
        cells = [species, f"{np.mean(list(built_in.values())):.3f}"]
        for lesson in lessons:
            for same in (True, False):
                shown = [
                    trial
                    for trial in own
                    if (trial.positive, trial.negative) == lesson
                    and trial.taught != BUILT_IN
                    and (trial.scene == trial.taught) == same
                ]
                shares = [trial.metrics.f1 / max(built_in[trial.scene], 1e-9) for trial in shown]
                mean = np.mean([trial.metrics.f1 for trial in shown]) if shown else np.nan
                cells.append(f"{mean:.3f} ({min(shares):.2f})" if shown else "–")
        lines.append(cells)
    return markdown(lines)


def words_csv(trials: Sequence[WordTrial]) -> str:
    """One line per trial, with unrounded figures."""
    text = io.StringIO()
    rows: list[Mapping[str, Any]] = []
    for trial in trials:
        flat = asdict(trial)
        rows.append({**flat, **flat.pop("metrics")})
    names = [name for name in rows[0] if name != "metrics"] if rows else []
    writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_words_csv(path: Path) -> list[WordTrial]:
    """The trials of an earlier run; none without such a file.

    Raises:
        FormatError: the file is damaged.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                WordTrial(
                    species=row["species"],
                    scene=row["scene"],
                    taught=row["taught"],
                    positive=int(row["positive"]),
                    negative=int(row["negative"]),
                    seconds=float(row["seconds"]),
                    metrics=metrics_of(row),
                )
                for row in csv.DictReader(file)
            ]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path} is damaged ({error}). Move it away; its trials are done again") from error
