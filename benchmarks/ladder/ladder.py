"""The ablation ladder of a scene: every stage counted and measured against the truth, and cached."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ...engine.config import Config
from ...engine.errors import FruitLangsError, VocabularyError
from ...engine.evaluation.calibration import calibration_error
from ...engine.evaluation.camera_errors import CameraErrors
from ...engine.evaluation.judgement import Judgement, judge
from ...engine.evaluation.metrics import CountMetrics, VisibilityClass, measure, measure_by_visibility
from ...engine.evaluation.renders import DEPTH, INSTANCES
from ...engine.evaluation.truth import Truth, read_truth, read_views, true_labels
from ...engine.language.encoders.open_encoder import open_encoder
from ...engine.progress import Progress, part, silent
from ...engine.scene.source import Source
from ...engine.storage.files import file_hash, files_hash, write_text
from ...engine.storage.keys import stage_key
from ..orchards import TRUTH, read_origin
from .mistakes import draw_mistakes
from .stages import END_TO_END, STAGES, TRUE_POSES, Counted, LadderStages

WITHOUT_MASKS = (TRUE_POSES, END_TO_END)
"""The stages that need no masks."""
_ROOMS = ("scene", "splatting", "language", "counting", "evaluation")


@dataclass(frozen=True, kw_only=True)
class StageResult:
    """One ablation stage of one scene.

    counted: number of fruit, None if it failed; near, far: measured at half a diameter and at one, None without a
    truth; classes: errors by visible fraction at half a diameter; ece: calibration error of the fruit's probabilities;
    interval, total_interval: of visible and of all fruit, if there are any; total_estimate: most likely number of all
    fruit; psnr, ssim: of held-out photos, if a scene was trained; views: number of views; cameras: errors of estimated
    cameras; seconds by stage; failed: why there is no count; mistakes: name of the picture of the worst ones.
    """

    species: str
    seed: int | None
    scene: str
    stage: str
    counted: int | None
    near: CountMetrics | None = None
    far: CountMetrics | None = None
    classes: Sequence[VisibilityClass] = ()
    ece: float = math.nan
    interval: tuple[float, float] | None = None
    total_interval: tuple[float, float] | None = None
    total_estimate: float | None = None
    psnr: float | None = None
    ssim: float | None = None
    views: int = 0
    cameras: CameraErrors | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    failed: str = ""
    mistakes: str = ""


def climb(
    folder: Path,
    out: Path,
    *,
    config: Config,
    prompts: Sequence[str] = (),
    stages: Collection[str] = tuple(STAGES),
    report: Callable[[str], None] = lambda _: None,
    progress: Progress = silent,
) -> list[StageResult]:
    """Count a scene in each of `stages` into `out` and measure each against the truth of the scene.

    prompts: what to count; the species of the scene if not given. A stage that an earlier run finished with the same
    inputs, settings and code is taken from `out`. A stage that fails is a row with its reason; the others continue. A
    scene without truth or masks is counted in the stages that need none, and measured as far as the truth allows.

    Raises:
        FruitLangsError: the scene or its truth cannot be read, the scene is incomplete, or nothing says what to count.
    """
    origin = read_origin(folder)
    if not prompts and not origin.species:
        raise VocabularyError(f"{folder} does not say what grows there. Give --prompt")
    asked = list(prompts) or [origin.species]
    truth_file = folder / TRUTH
    truth = read_truth(truth_file, true_labels(asked)) if truth_file.is_file() else None
    if truth is None:
        report(f"{folder.name}: no {TRUTH}; counted and not measured")
    masks = sorted(path for name in (INSTANCES, DEPTH) for path in (folder / name).glob("*.png"))
    chosen = [name for name in STAGES if name in stages and (name in WITHOUT_MASKS or (truth is not None and masks))]
    dropped = [name for name in stages if name not in chosen]
    if dropped:
        report(f"{folder.name}: no true masks for {', '.join(dropped)}")
    bench = LadderStages(folder, out, truth, read_views(truth_file) if truth else [], asked, config)
    inputs = [Source(path=folder).hash(), file_hash(truth_file) if truth else "", files_hash(masks, folder)]
    made_by = _make_key(config)
    rows = []
    for number, name in enumerate(chosen):
        share = part(progress, number / len(chosen), (number + 1) / len(chosen))
        key = stage_key(_ROOMS, made_by, *inputs, config, name, *asked)
        row = StageResult(species=origin.species, seed=origin.seed, scene=out.name, stage=name, counted=None)
        try:
            counted = _read_kept(out / f"{name}.json", key)
            if counted is None:
                counted = bench.run(name, share)
                write_text(out / f"{name}.json", _dump(counted, key))
            found = _add_count(row, counted)
            if truth is not None:
                instances = bench.instances if masks else ()
                judgement = judge(counted.centers, counted.diameters, truth)
                picture = out / f"mistakes_{name}.png"
                draw_mistakes(picture, bench.scene, truth, counted, judgement, instances)
                found = _add_measures(found, counted, truth, judgement, picture.name)
            row = found
        except FruitLangsError as error:
            row = dataclasses.replace(row, failed=" ".join(str(error).split()))
        report(_line(row))
        rows.append(row)
    return rows


def _make_key(config: Config) -> str:
    """Make the key of what a count depends on besides the code of packages and the inputs: the pipeline's own code,
    weights and pycolmap."""
    root = Path(__file__).resolve().parents[2]
    chain = [root / "engine" / name for name in ("pipeline.py", "reconstruction.py")]
    own = [root / "benchmarks" / "ladder" / name for name in ("stages.py", "frames.py")]
    code = files_hash([*own, *chain], root)
    return f"{code} {open_encoder(config.embed).identity} {version('pycolmap')}"


def _add_count(row: StageResult, counted: Counted) -> StageResult:
    return dataclasses.replace(
        row,
        counted=len(counted.centers),
        interval=counted.interval,
        total_interval=counted.total_interval,
        total_estimate=counted.total_estimate,
        psnr=counted.psnr,
        ssim=counted.ssim,
        views=counted.views,
        cameras=counted.cameras,
        seconds=counted.seconds,
    )


def _add_measures(row: StageResult, counted: Counted, truth: Truth, judgement: Judgement, picture: str) -> StageResult:
    return dataclasses.replace(
        row,
        near=measure(judgement, truth),
        far=measure(judge(counted.centers, counted.diameters, truth, 1.0), truth),
        classes=measure_by_visibility(judgement, truth),
        ece=_fruit_calibration(counted, judgement),
        mistakes=picture,
    )


def _fruit_calibration(counted: Counted, judgement: Judgement) -> float:
    """Calibration error of the probabilities of all predictions that are not ignored."""
    judged = np.ones(len(counted.centers), bool)
    judged[judgement.ignored] = False
    hits = np.zeros(len(counted.centers), bool)
    hits[judgement.pairs.predicted] = True
    return calibration_error(counted.probabilities[judged], hits[judged])


def _dump(counted: Counted, key: str) -> str:
    document = {name: getattr(counted, name) for name in Counted.__dataclass_fields__}
    for name in ("centers", "diameters", "probabilities"):
        document[name] = document[name].tolist()
    document["cameras"] = counted.cameras and dataclasses.asdict(counted.cameras)
    return json.dumps({"key": key, **document, "seconds": dict(counted.seconds)}, indent=1) + "\n"


def _read_kept(path: Path, key: str) -> Counted | None:
    """Read the count of an earlier run with this key; a damaged record is computed again."""
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if document.pop("key") != key:
            return None
        document["centers"] = np.array(document["centers"], np.float64).reshape(-1, 3)
        for name in ("diameters", "probabilities"):
            document[name] = np.array(document[name], np.float64)
        for name in ("interval", "total_interval"):
            document[name] = None if document[name] is None else tuple(document[name])
        document["cameras"] = CameraErrors(**document["cameras"]) if document["cameras"] else None
        return Counted(**document)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _line(row: StageResult) -> str:
    if row.failed:
        return f"{row.scene}, {row.stage}: failed: {row.failed}"
    text = f"{row.scene}, {row.stage}: {row.counted} counted"
    if row.near is None:
        return text
    return f"{text}, {row.near.visible} visible, F1 {row.near.f1:.3f}"
