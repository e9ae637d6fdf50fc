"""Damage every kind of file that FruitLangs reads, and check that each is read or refused with a sentence.

    python scripts/checks/fuzz_readers.py --cases 2000 --seed 0 --out results/fuzz

Valid files are made first: a result of the sample after a short training, a video, manifests, a taught word and others.
Each case damages one of them and reads it in another process, whose memory is limited. It fails if the reader raises
anything but a `FruitLangsError`, takes longer than a minute, uses more than 300 MB besides the file, or ends the
process. --only NUMBER repeats a case with its traceback. Exit code 1 if a case failed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import resource
import shutil
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from _terminal import report, run
from fruitlangs.benchmarks.ladder.stages import write_transforms
from fruitlangs.engine.block.inputs import read_inputs
from fruitlangs.engine.block.ledger import Ledger, TreeState
from fruitlangs.engine.block.manifest import TreeEntry, read_manifest
from fruitlangs.engine.block.publish import publish_again, publish_block
from fruitlangs.engine.block.reviews import Review, fruit_of, write_review
from fruitlangs.engine.config import Config, TrainConfig
from fruitlangs.engine.counting.accounts.review import Decision, ball
from fruitlangs.engine.counting.published.template_shape import read_template
from fruitlangs.engine.errors import Cancelled, CountingError, FruitLangsError
from fruitlangs.engine.evaluation.truth import read_truth
from fruitlangs.engine.language.features.features import load_features
from fruitlangs.engine.language.features.photo_features import load_photo_features
from fruitlangs.engine.language.taught.word import Example, TaughtWord, read_word, save_word
from fruitlangs.engine.open_result import open_result
from fruitlangs.engine.pipeline import count_scene
from fruitlangs.engine.report.results import FRUITS_JSON, parse_results
from fruitlangs.engine.report.selection import read_selection
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.scene.formats.cameras_json import read_cameras
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.scene.video.stills import choose_stills
from fruitlangs.engine.splatting.imported.read_ply import read_imported_ply
from fruitlangs.engine.splatting.ply import read_ply
from fruitlangs.engine.splatting.training.checkpoint import read_checkpoint
from fruitlangs.engine.splatting.training.train import train
from fruitlangs.engine.storage.files import read_tensors

SAMPLE = Path(__file__).resolve().parents[2] / "examples" / "orchard_tree"
SECONDS, ROOM = 60.0, 300 << 20
"""The most time of a case, and the bytes of memory that it may use besides those of its files."""
COMPLETE, KEY, PHOTO, TRUTH = "complete", "key.txt", "001.jpg", "truth.json"
SHORT = Config(train=TrainConfig(steps=40, max_gaussians=3000, checkpoint_every=20))


@dataclass(frozen=True)
class Kind:
    """A kind of input. files: in the folder of valid files, of which one is damaged, with all that the reader needs
    next to it; reader: of the folder and the damaged file."""

    files: tuple[str, ...]
    reader: Callable[[Path, Path], object]


def _read_photos(folder: Path, _: Path) -> object:
    scene = read_scene(folder / "scene")
    return [photo.pixels() for photo in scene.images[:3]]


def _read_checkpoint(folder: Path, path: Path) -> object:
    return read_checkpoint(path, (folder / KEY).read_text(encoding="utf-8"))


def _read_block(folder: Path, _: Path) -> object:
    return publish_again(Ledger(folder / "block"))


KINDS: Mapping[str, Kind] = {
    "COLMAP model": Kind(
        ("scene/sparse/0/cameras.bin", "scene/sparse/0/images.bin", "scene/sparse/0/points3D.bin"), _read_photos
    ),
    "photo": Kind((f"scene/images/{PHOTO}",), _read_photos),
    "transforms.json": Kind(("frames/transforms.json",), lambda folder, _: read_scene(folder / "frames")),
    "video": Kind(("walk.mp4",), lambda folder, path: choose_stills(path, folder / "stills")),
    "manifest": Kind(("orchard.csv", "orchard.toml"), lambda _, path: read_manifest(path)),
    "taught word": Kind(("fig.fruitword",), lambda _, path: read_word(path)),
    "Gaussians": Kind(("result/gaussians.ply",), lambda _, path: (read_ply(path), read_imported_ply(path))),
    "features": Kind(("result/features.safetensors",), lambda _, path: load_features(path)),
    "photo features": Kind(("result/photos.safetensors",), lambda _, path: list(load_photo_features(path).photos())),
    "selection": Kind(("result/selection.safetensors",), lambda _, path: read_selection(path)),
    "cameras.json": Kind(("result/cameras.json",), lambda _, path: read_cameras(path)),
    "result": Kind(("result/fruits.json",), lambda folder, _: open_result(folder / "result")),
    "checkpoint": Kind(("checkpoint.safetensors",), _read_checkpoint),
    "template": Kind(("template.ply",), lambda _, path: read_template(path)),
    "block": Kind(
        tuple(
            f"block/{name}"
            for name in (
                "manifest.json",
                "states/a.json",
                "trees/a/fruits.json",
                "trees/a/review.json",
                "trees/b/fruits.json",
                "orchard.json",
            )
        ),
        _read_block,
    ),
    "truth": Kind((f"scene/{TRUTH}",), lambda _, path: read_truth(path)),
}


def main(given: Sequence[str] | None = None) -> None:
    """Run all cases and print a table.

    Raises:
        CountingError: a case failed.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, metavar="NUMBER", help="repeat one case, with its traceback")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the valid files")
    arguments = parser.parse_args(given)
    valid = arguments.out / "valid"
    if not (valid / COMPLETE).is_file():
        report("making valid files")
        make_valid(valid)
    if arguments.only is not None:
        print(f"{describe(arguments.only)}: {attempt(valid, arguments.seed, arguments.only, show=True)}")
        return
    for name, kind in KINDS.items():
        with tempfile.TemporaryDirectory(dir=valid.parent) as folder:
            place = link_files(valid, Path(folder) / "case")
            for file in kind.files:
                report(f"{name}: {file} is read undamaged")
                kind.reader(place, place / file)
    told, failed = Counter[tuple[str, str]](), []
    for number, outcome in enumerate(run_cases(valid, arguments.seed, arguments.cases)):
        told[describe(number), outcome.partition(":")[0]] += 1
        if outcome not in ("read", "refused"):
            failed.append(f"case {number}, {describe(number)}: {outcome}")
            report(failed[-1])
    for name in KINDS:
        print(f"{name:<16}" + "".join(f"{told[name, each]:>6} {each}" for each in ("read", "refused", "failed")))
    if failed:
        raise CountingError(f"{len(failed)} of {arguments.cases} cases failed. The first: {failed[0]}")


def describe(number: int) -> str:
    """Describe the kind of input of a case."""
    return list(KINDS)[number % len(KINDS)]


def run_cases(valid: Path, seed: int, cases: int) -> list[str]:
    """Return what became of each case: `read`, `refused`, or `failed: REASON`; each runs in a child that a hang
    ends."""
    context, found = multiprocessing.get_context("spawn"), list[str]()
    while len(found) < cases:
        ours, theirs = context.Pipe()
        child = context.Process(target=_run_child, args=(theirs, valid, seed, len(found), cases), daemon=True)
        child.start()
        theirs.close()
        try:
            while len(found) < cases:
                if not ours.poll(SECONDS):
                    found.append(f"failed: no answer after {SECONDS:.0f} s")
                    break
                found.append(ours.recv())
                if len(found) % 200 == 0:
                    report(f"{len(found)} of {cases} cases")
        except EOFError:
            found.append("failed: the process died")
        child.kill()
        child.join()
    return found


def _run_child(answers: Connection, valid: Path, seed: int, first: int, cases: int) -> None:
    """Run cases from `first` on."""
    for number in range(first, cases):
        answers.send(attempt(valid, seed, number))


def attempt(valid: Path, seed: int, number: int, *, show: bool = False) -> str:
    """Damage a file as the case says, and read it."""
    random, kind = np.random.default_rng([seed, number]), KINDS[describe(number)]
    name = kind.files[random.integers(len(kind.files))]
    with tempfile.TemporaryDirectory(dir=valid.parent) as folder:
        place = Path(folder) / "case"
        path = link_files(valid, place) / name
        content = damage(path.read_bytes(), random)
        path.unlink()
        path.write_bytes(content)
        try:
            with _limit_memory(4 * path.stat().st_size + ROOM):
                kind.reader(place, path)
        except FruitLangsError as error:
            text = str(error)
            return "refused" if text.strip() and len(text) < 2000 else f"failed: unclear message {text[:80]!r}"
        except BaseException as error:  # also what ends a process
            if show:
                traceback.print_exc()
            return f"failed: {type(error).__name__}: {' '.join(str(error).split())[:120]}"
    return "read"


def link_files(valid: Path, place: Path) -> Path:
    """Make a folder with links to all valid files."""
    return Path(shutil.copytree(valid, place, symlinks=True, copy_function=os.link))


@contextmanager
def _limit_memory(room: int) -> Iterator[None]:
    """Let this process use no more than `room` bytes of address space in addition to what it has."""
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (used + room, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def damage(data: bytes, random: np.random.Generator) -> bytes:
    """Return the bytes with one to three kinds of damage."""
    for _ in range(random.integers(1, 4)):
        data = DAMAGES[random.integers(len(DAMAGES))](data, random)
    return data


def _flip(data: bytes, random: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for place in random.integers(0, max(len(data), 1), random.integers(1, 20)) if data else ():
        changed[place] ^= int(random.integers(1, 256))
    return bytes(changed)


def _cut(data: bytes, random: np.random.Generator) -> bytes:
    return data[: random.integers(0, len(data) + 1)]


def _remove(data: bytes, random: np.random.Generator) -> bytes:
    first, last = np.sort(random.integers(0, len(data) + 1, 2))
    return data[:first] + data[min(last, first + 200) :]


def _repeat(data: bytes, random: np.random.Generator) -> bytes:
    first, last = np.sort(random.integers(0, len(data) + 1, 2))
    return data[:last] + data[first:last] + data[last:]


def _fill(data: bytes, random: np.random.Generator) -> bytes:
    place = int(random.integers(0, len(data) + 1))
    value = bytes([int(random.choice([0x00, 0xFF, 0x7F]))]) * int(random.integers(1, 16))
    return data[:place] + value + data[place + len(value) :]


def _replace_number(data: bytes, random: np.random.Generator) -> bytes:
    """Replace one number in the text of a file by a value that is out of place."""
    start = int(random.integers(0, len(data) + 1))
    found = re.search(rb"\d", data[start : start + 10_000])
    if found is None:
        return data
    first = last = start + found.start()
    while last < len(data) and (data[last : last + 1].isdigit() or data[last : last + 1] in b".eE-"):
        last += 1
    odd = (b"NaN", b"-1", b"1e308", b"99999999999999999999", b"0", b"null", b'"x"', b"[]", b"{}", b"Infinity", b"")
    return data[:first] + odd[random.integers(len(odd))] + data[last:]


DAMAGES = (_flip, _flip, _cut, _remove, _repeat, _fill, _replace_number, _replace_number)


def make_valid(valid: Path) -> None:
    """Write a valid file of each kind."""
    shutil.rmtree(valid, ignore_errors=True)
    (valid / "scene" / "images").mkdir(parents=True)
    shutil.copytree(SAMPLE / "sparse", valid / "scene" / "sparse")
    shutil.copyfile(SAMPLE / TRUTH, valid / "scene" / TRUTH)
    for photo in sorted((SAMPLE / "images").iterdir()):
        copy = valid / "scene" / "images" / photo.name
        if photo.name == PHOTO:
            shutil.copyfile(photo, copy)
        else:
            copy.symlink_to(photo)
    scene = read_scene(SAMPLE)
    (valid / "frames").mkdir()
    poses = {
        Path(photo.name).name: camera.world_to_camera for photo, camera in zip(scene.images, scene.cameras, strict=True)
    }
    write_transforms(valid / "frames" / "transforms.json", scene, poses)
    _write_video(valid / "walk.mp4", [photo.pixels() for photo in scene.images[:24]])
    (valid / "orchard.csv").write_text("id;source;prompt;row\na;scene;apple;1\nb;frames;apple;2\n", encoding="utf-8")
    tree = '[[tree]]\nid = "a"\nsource = "scene"\nprompt = "apple"\n'
    (valid / "orchard.toml").write_text(f"{tree}[tree.settings]\n'train.steps' = 40\n", encoding="utf-8")
    save_word(valid / "fig.fruitword", _make_word())
    trimesh.creation.icosphere(subdivisions=2).export(valid / "template.ply")
    count_scene(SAMPLE, ["apple"], valid / "result", config=SHORT)
    shutil.rmtree(valid / "result" / "cache")
    _write_checkpoint(scene, valid / "checkpoint.safetensors")
    _write_block(valid)
    (valid / COMPLETE).touch()


def _write_block(valid: Path) -> None:
    """A block with a reviewed tree, and a row of two trees without a review."""
    ledger = Ledger(valid / "block")
    trees = [
        TreeEntry(id=name, source=valid / "scene", prompt=("apple",), latitude=47.0, longitude=9.0) for name in "ab"
    ]
    ledger.write_trees(trees)
    document = parse_results(valid / "result" / FRUITS_JSON)
    for tree in trees:
        folder = ledger.result(tree).path
        folder.mkdir(parents=True)
        done = TreeState(stage="done", fingerprint=tree.fingerprint, inputs=read_inputs(tree), run="1", seconds=3.0)
        ledger.write(tree, done)
    one, row = (ledger.result(tree).path for tree in trees)
    (one / FRUITS_JSON).write_text(json.dumps(document, indent=1), encoding="utf-8")
    added = Decision("add", "2026-11-28T10:00:00Z", "", (), (ball(1, "apple", np.zeros(3), 0.08),))
    write_review(one, document["set_id"], Review(fruits=fruit_of(document, None), decisions=[added]))
    common = {"count": 3, "likely": 3.5, "interval": [3, 6], "total": 5.0, "total_interval": [3, 9]}
    pair = [{"number": k + 1, "position": [0.0, 4.0 * k, 0.0], **common} for k in range(2)]
    fruits = [{**fruit, "tree": 1 + k % 2} for k, fruit in enumerate(document["fruits"])]
    row_document = {**document, "trees": pair, "fruits": fruits}
    (row / FRUITS_JSON).write_text(json.dumps(row_document, indent=1), encoding="utf-8")
    publish_block(ledger, all_trees=40, density=900.0)


def _make_word() -> TaughtWord:
    random = np.random.default_rng(0)
    vectors = torch.from_numpy(random.normal(size=(6, 8))).half()
    return TaughtWord(
        name="fig",
        encoder_id="fuzz",
        weights=torch.ones(8),
        bias=0.5,
        vectors=vectors,
        positive=torch.tensor([True] * 3 + [False] * 3),
        prior=torch.zeros(6),
        groups=torch.tensor([0, 0, 0, 1, 1, 1]),
        examples=(Example(True, "a.jpg:1,2", 3), Example(False, "a.jpg:3,4", 3)),
    )


def _write_video(path: Path, pictures: Sequence[NDArray[np.uint8]]) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.height, stream.width = pictures[0].shape[:2]
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def _write_checkpoint(scene: Scene, path: Path) -> None:
    """The checkpoint of a training that is interrupted."""

    def stop(*_: object) -> None:
        if path.is_file():
            raise Cancelled("a checkpoint is written")

    with suppress(Cancelled):
        train(scene, SHORT.train, checkpoint=path, progress=stop)
    path.with_name(KEY).write_text(read_tensors(path)[1]["key"], encoding="utf-8")


if __name__ == "__main__":
    run(main)
