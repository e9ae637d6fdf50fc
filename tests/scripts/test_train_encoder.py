"""The training script: labels from boxes and masks, pasting, the loss, and a whole tiny run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from fruitlangs.engine.errors import ConfigError, EncoderError, FormatError
from fruitlangs.engine.evaluation.calibration import BINS
from fruitlangs.engine.language.encoders.embedded import Calibration, EmbeddedEncoder, read_weights, save_weights
from fruitlangs.engine.language.encoders.network import DEPTHS, WIDTHS, Network
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS, FRUITS
from fruitlangs.fitting import train_encoder
from fruitlangs.fitting.encoder.batches import CROP, Material, _crop, make_batch
from fruitlangs.fitting.encoder.confusable import find_colour_distinctions, find_distinctions
from fruitlangs.fitting.encoder.learning import Course, learn
from fruitlangs.fitting.encoder.lifted import (
    SHARPEST,
    LiftedScene,
    calibrate_lifted,
    find_rendered_scenes,
    intersection_over_union,
    measure_lifted,
)
from fruitlangs.fitting.encoder.losses import concept_loss, overlap_loss
from fruitlangs.fitting.encoder.pasting import cut_fruit, cut_objects, paste
from fruitlangs.fitting.encoder.photo_scores import score_pasted_words, score_photos
from fruitlangs.fitting.encoder.pictures import (
    IGNORED,
    LEAST_WALK,
    NOT_FRUIT,
    Box,
    Picture,
    box_labels,
    put_object,
    read_photos,
    read_renders,
    training_seeds,
)
from fruitlangs.fitting.encoder.reliability import judge_probabilities
from fruitlangs.fitting.encoder.samples import Sample, interpolate, sample
from fruitlangs.orchard.config import FIRST_TRAINING_SEED
from fruitlangs.orchard.training_scenes import is_held_out, training_config

APPLE, LEAF, OBJECT, BACKGROUND = map(CONCEPTS.index, ("apple", "leaf", "object", "background"))


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sets of two 64×64 photos with one box each."""
    root = tmp_path_factory.mktemp("photos")
    rng = np.random.default_rng(0)
    for label in ("apple", "pear"):
        (root / label / "images").mkdir(parents=True)
        rows = ["image,split,label,xmin,ymin,xmax,ymax"]
        for split in ("train", "val"):
            pixels = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(root / label / "images" / f"{split}.png")
            rows.append(f"images/{split}.png,{split},{label},20,20,44,40")
        (root / label / "annotations.csv").write_text("\n".join(rows) + "\n")
    return root


@pytest.fixture(scope="module")
def renders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scenes of one 64×64 picture, an apple of 24 px on leaves; the last one's seed is held out."""
    root = tmp_path_factory.mktemp("renders")
    y, x = np.mgrid[:64, :64]
    apple = (x - 30) ** 2 + (y - 30) ** 2 < 12**2
    for seed in range(1065, 1073):
        scene = root / f"scene_{seed}"
        for folder in ("images", "classes", "instances"):
            (scene / folder).mkdir(parents=True)
        colors = np.where(apple[..., None], (180, 30, 30), (60, 110, 40)).astype(np.uint8)
        Image.fromarray(colors).save(scene / "images" / "001.jpg")
        Image.fromarray(apple.astype(np.uint8)).save(scene / "classes" / "001.png")
        Image.fromarray(apple.astype(np.uint16)).save(scene / "instances" / "001.png")
        (scene / "classes.json").write_text(json.dumps({"0": "leaf", "1": "apple"}))
        (scene / "orchard.json").write_text(json.dumps({"config": {"seed": seed}}))
    return root


def test_a_box_is_fruit_in_its_centre_unknown_around_it_and_no_fruit_outside():
    labels = box_labels([Box("apple", 20, 20, 40, 40)], (64, 64))
    assert labels[30, 30] == APPLE
    assert labels[21, 21] == IGNORED
    assert labels[30, 18] == NOT_FRUIT
    assert np.isclose((labels == APPLE).sum(), np.pi * 6**2, rtol=0.1)


def test_photos_are_read_by_split_with_their_set_as_source(photos: Path):
    pictures = read_photos(photos, "val")
    assert [picture.source for picture in pictures] == ["apple", "pear"]
    assert [box.label for box in pictures[1].boxes] == ["pear"]


def test_a_folder_without_annotations_is_named(tmp_path: Path):
    with pytest.raises(FormatError, match=r"no folder with an annotations\.csv"):
        read_photos(tmp_path, "train")


def test_a_broken_row_is_named_by_file_and_line(tmp_path: Path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "annotations.csv").write_text(
        "image,split,label,xmin,ymin,xmax,ymax\na.jpg,train,apple,1,2,x,4\n"
    )
    with pytest.raises(FormatError, match=r"annotations\.csv line 2"):
        read_photos(tmp_path, "train")


def test_masks_of_renders_become_words(renders: Path):
    pictures = read_renders(renders)
    assert set(np.unique(pictures[0].labels)) == {APPLE, LEAF}


def test_the_seeds_of_the_scenes_are_read_and_those_of_tests_refused(renders: Path, tmp_path: Path):
    assert training_seeds(renders.iterdir()) == list(range(1065, 1073))
    (tmp_path / "orchard.json").write_text(json.dumps({"config": {"seed": 2}}))
    with pytest.raises(FormatError, match="has seed 2, and seeds below 1000 are for tests alone"):
        training_seeds([tmp_path])
    with pytest.raises(FormatError, match="does not tell the scene's seed"):
        training_seeds([tmp_path / "none"])


def test_a_rendered_tree_is_calibrated_on_and_not_trained_on_and_its_seed_is_checked(photos: Path, tmp_path: Path):
    walk = tmp_path / "renders" / "2"
    (walk / "images").mkdir(parents=True)
    for number in range(LEAST_WALK):
        (walk / "images" / f"{number:03}.jpg").touch()
    (walk / "classes.json").write_text("{}")
    assert find_rendered_scenes(walk.parent) == []  # not finished
    (walk / "truth.json").touch()
    assert find_rendered_scenes(walk.parent) == [walk]
    with pytest.raises(FormatError, match="has no scene"):
        read_renders(walk.parent)
    (walk / "orchard.json").write_text(json.dumps({"config": {"seed": 2}}))
    with pytest.raises(FormatError, match="has seed 2"):
        training_seeds(find_rendered_scenes(walk.parent))


def test_held_out_scenes_are_no_training_scenes(renders: Path):
    train, held_out = train_encoder.split_scenes(read_renders(renders))
    assert [picture.seed for picture in held_out] == [1072]
    assert [picture.seed for picture in train] == list(range(1065, 1072))


def test_a_scene_is_held_out_whatever_other_scenes_lie_next_to_it():
    seeds = range(FIRST_TRAINING_SEED, FIRST_TRAINING_SEED + 1000)
    held_out = [training_config(seed) for seed in seeds if is_held_out(seed)]
    assert len(held_out) == len(seeds) // 11 // 8 * 8
    every = {(each.species, each.variant) for each in map(training_config, seeds)}
    assert {(each.species, each.variant) for each in held_out} == every


def test_scenes_that_earlier_runs_learnt_from_are_not_measured_on(renders: Path):
    _, held_out = train_encoder.split_scenes(read_renders(renders))
    train_encoder.check_unseen(held_out, train_encoder.Past([], [1071, 1073]))
    with pytest.raises(ConfigError, match=r"learnt from seed 1072.*Take these scenes out"):
        train_encoder.check_unseen(held_out, train_encoder.Past([], [1072]))


def test_pasted_fruit_brings_its_label(renders: Path):
    cutout = cut_fruit(read_renders(renders))[APPLE][0]
    pixels, labels = np.zeros((64, 64, 3), np.uint8), np.full((64, 64), LEAF, np.uint8)
    box = paste(pixels, labels, cutout, 20, np.random.default_rng(0), occlude=False)
    assert box is not None
    assert labels[int(box.top) + 10, int(box.left) + 10] == APPLE
    assert pixels[int(box.top) + 10, int(box.left) + 10, 0] > 90
    assert labels[int(box.top) - 1, int(box.left) - 1] == LEAF


def test_objects_that_no_word_names_are_cut_out_with_their_own_label(renders: Path):
    picture = read_renders(renders)[0]
    labels = np.where(picture.labels == APPLE, OBJECT, picture.labels).astype(np.uint8)
    cutouts = cut_objects([replace(picture, labels=labels)])
    assert [cutout.concept for cutout in cutouts] == [OBJECT]
    pixels, marks = np.zeros((64, 64, 3), np.uint8), np.full((64, 64), NOT_FRUIT, np.uint8)
    box = paste(pixels, marks, cutouts[0], 20, np.random.default_rng(0), occlude=False)
    assert box is not None
    assert box.label == "object"
    assert marks[int(box.top) + 10, int(box.left) + 10] == OBJECT


def test_a_drawn_object_is_labelled_as_one():
    pixels, labels = np.zeros((128, 128, 3), np.uint8), np.full((128, 128), BACKGROUND, np.uint8)
    put_object(pixels, labels, np.random.default_rng(5))
    drawn = pixels.any(-1)
    assert drawn.any()
    assert (labels[drawn] != BACKGROUND).mean() > 0.9
    assert (labels == OBJECT).sum() > 0.8 * drawn.sum()


def test_a_batch_depends_on_its_seed_alone(photos: Path, renders: Path):
    pictures = read_renders(renders)
    material = Material(read_photos(photos, "train"), pictures, cut_fruit(pictures))
    (images, labels), again = (make_batch(material, 3, np.random.default_rng(4)) for _ in range(2))
    assert torch.equal(images, again[0])
    assert torch.equal(labels, again[1])
    assert images.shape == (3, 3, CROP, CROP)
    assert float(images.min()) >= 0.0
    assert float(images.max()) <= 1.0


def test_few_fruit_pixels_weigh_as_much_as_many():
    right = torch.zeros(1, len(CONCEPTS), 32, 32)
    right[:, LEAF] = 6.0
    few, many = torch.full((1, 32, 32), LEAF), torch.full((1, 32, 32), LEAF)
    few[:, :2, :2], many[:, :16] = APPLE, APPLE
    assert float(concept_loss(right.log_softmax(1), few)) == pytest.approx(
        float(concept_loss(right.log_softmax(1), many)), rel=1e-3
    )


def test_no_fruit_is_content_with_any_word_of_the_surroundings():
    labels = torch.full((1, 8, 8), NOT_FRUIT)
    for word in CONCEPTS:
        logits = torch.zeros(1, len(CONCEPTS), 8, 8)
        logits[:, CONCEPTS.index(word)] = 20.0
        assert (float(concept_loss(logits.log_softmax(1), labels)) < 0.01) == (word not in FRUITS)


def test_a_pixel_outside_all_boxes_that_is_certainly_fruit_has_little_weight():
    labels = torch.full((1, 8, 8), NOT_FRUIT)
    mean_gradients = []
    for sure in (4.0, 9.0):
        logits = torch.zeros(1, len(CONCEPTS), 8, 8)
        logits[:, APPLE] = sure
        logits.requires_grad_()
        concept_loss(logits.log_softmax(1), labels).backward()
        assert logits.grad is not None
        mean_gradients.append(float(logits.grad[:, APPLE].sum()))
    assert mean_gradients[0] > 5.0 * mean_gradients[1] > 0.0


def test_the_loss_of_overlap_is_the_share_of_the_union_that_is_missed():
    labels = torch.full((2, 8, 8), LEAF)
    labels[0, :4] = APPLE  # the second picture shows no fruit and has no say
    logits = torch.zeros(2, len(CONCEPTS), 8, 8)
    logits[:, LEAF] = 40.0
    logits[0, APPLE, :2] = 80.0
    assert float(overlap_loss(logits.log_softmax(1), labels)) == pytest.approx(0.5, abs=1e-4)
    logits[0, APPLE, :4] = 80.0
    assert float(overlap_loss(logits.log_softmax(1), labels)) == pytest.approx(0.0, abs=1e-4)
    labels[0, 4:] = IGNORED
    logits[0, APPLE] = 80.0
    assert float(overlap_loss(logits.log_softmax(1), labels)) == pytest.approx(0.0, abs=1e-4)


def test_ignored_pixels_teach_nothing():
    labels = torch.full((1, 8, 8), LEAF)
    labels[:, 4:] = IGNORED
    logits = torch.zeros(1, len(CONCEPTS), 8, 8, requires_grad=True)
    concept_loss(logits.log_softmax(1), labels).backward()
    assert logits.grad is not None
    assert logits.grad[:, :, :4].any()
    assert not logits.grad[:, :, 4:].any()


def test_the_calibration_of_lifted_gaussians_finds_the_middle_and_is_never_overconfident():
    rng = np.random.default_rng(0)
    fruit = rng.random(4000) < 0.1
    margins = np.where(fruit, 1.0, -3.0) + rng.normal(0.0, 0.6, 4000)
    scene = LiftedScene(margins, fruit, np.ones(4000))
    calibration = calibrate_lifted([scene], Calibration(kind_temperature=1.3)).calibration
    assert calibration.temperature == SHARPEST
    assert -1.3 < calibration.bias * calibration.temperature < -0.3
    assert calibration.kind_temperature == 1.3
    assert intersection_over_union([scene], calibration) > 0.97


def test_rendered_trees_are_judged_by_the_calibration_of_the_others():
    rng = np.random.default_rng(0)
    fruit = rng.random(4000) < 0.2
    near = LiftedScene(np.where(fruit, 2.0, -2.0) + rng.normal(0.0, 1.0, 4000), fruit, np.ones(4000))
    far = LiftedScene(near.margins + 6.0, fruit, np.ones(4000))
    alike, apart = measure_lifted([near, near], Calibration()), measure_lifted([near, far], Calibration())
    assert alike is not None
    assert apart is not None
    assert alike.calibration_error < 0.05 < 0.3 < apart.calibration_error
    assert alike.iou > 0.85 > 0.6 > apart.iou
    assert measure_lifted([near], Calibration()) is None


def test_true_probabilities_have_no_calibration_error_and_overconfident_ones_have():
    rng = np.random.default_rng(1)
    probability = rng.beta(0.3, 2.0, 60_000)
    truth = rng.random(60_000) < probability
    prior = float(truth.mean())
    honest = judge_probabilities(probability, truth, prior)
    sure = judge_probabilities(probability**3 / (probability**3 + (1 - probability) ** 3), truth, prior)
    constant = judge_probabilities(np.full(60_000, prior), truth, prior)
    assert honest is not None
    assert sure is not None
    assert constant is not None
    assert honest.calibration_error < 0.01 < 0.08 < sure.calibration_error
    assert constant.calibration_error < 0.02
    assert honest.brier < 0.2 < constant.brier == pytest.approx(constant.constant_brier)
    assert len(honest.predicted) == len(honest.observed) == BINS
    assert judge_probabilities(probability, np.zeros(60_000, bool), 0.1) is None


def test_the_most_confused_word_is_named_and_words_of_few_pixels_are_left_out():
    truth = np.array(["leaf"] * 200 + ["grass"] * 200 + ["sky"] * 200 + ["tag"] * 5)
    leaf = np.concatenate([np.linspace(0.4, 1.0, 200), np.linspace(0.2, 0.8, 200), np.zeros(205)])
    found = find_distinctions({"leaf": leaf, "grass": -leaf, "sky": np.zeros(605), "tag": leaf}, truth)
    assert found["leaf"].against == "grass"
    assert 0.6 < found["leaf"].auc < 0.9
    assert "tag" not in found


def test_a_general_word_is_not_compared_with_those_it_includes():
    truth = np.array(["leaf"] * 200 + ["grass"] * 200 + ["sky"] * 200)
    plant = np.concatenate([np.linspace(0.4, 1.0, 400), np.linspace(0.2, 0.8, 200)])
    found = find_distinctions(
        {"grass": plant, "sky": -plant, "plant": plant}, truth, general={"plant": ("leaf", "grass")}
    )
    assert found["plant"].against == found["grass"].against == "sky"


def test_colour_words_agree_with_what_people_call_colours():
    found = find_colour_distinctions()
    assert len(found) >= 9
    assert min(each.auc for each in found.values()) >= 0.8


@pytest.mark.parametrize("step", [1, 4])
def test_outputs_of_a_photos_size_are_read_at_its_pixels(step: int):
    outputs = torch.rand(13, 22, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(interpolate(outputs, (13, 22), step), outputs[::step, ::step], atol=1e-5, rtol=0.0)


def test_outputs_smaller_than_a_photo_are_read_where_they_cover_its_pixels():
    down, right = torch.meshgrid(torch.arange(5.0), torch.arange(9.0), indexing="ij")
    found = interpolate(torch.stack([down, right], dim=-1), (20, 27), 4)
    rows = ((torch.arange(0, 20, 4) + 0.5) / 4.0 - 0.5).clamp(0.0, 4.0)
    columns = ((torch.arange(0, 27, 4) + 0.5) / 3.0 - 0.5).clamp(0.0, 8.0)
    torch.testing.assert_close(found[..., 0], rows[:, None].expand(5, 7))
    torch.testing.assert_close(found[..., 1], columns.expand(5, 7))


def test_every_measured_pixel_of_a_large_photo_has_its_features_and_label():
    pixels = np.random.default_rng(0).integers(0, 256, (50, 1200, 3), dtype=np.uint8)
    encoder = EmbeddedEncoder.open()
    (measured,) = sample(encoder, [Picture(pixels, np.full((50, 1200), APPLE, np.uint8), "apple")])
    assert encoder.encode_dense(pixels).shape[:2] == (20, 480)
    assert measured.features.shape == (13 * 300, encoder.dimension)
    assert len(measured.labels) == len(measured.colours) == len(measured.boxed) == 13 * 300


def test_pasted_words_are_read_in_photos_larger_than_what_is_seen():
    rng, photos = np.random.default_rng(0), []
    for word in ("apple", "pear"):
        pixels = rng.integers(0, 256, (60, 1200, 3), dtype=np.uint8)
        boxes = [Box(word, 100, 10, 140, 50)]
        photos.append(Picture(pixels, box_labels(boxes, (60, 1200)), word, boxes))
    shares = score_pasted_words(EmbeddedEncoder.open(), photos, each=1)
    assert set(shares) == {"apple", "pear"}
    assert all(0.0 <= share <= 1.0 for share in shares.values())


def test_fruit_without_a_box_counts_against_the_encoder_until_the_user_marks_it(tmp_path: Path):
    fruit, missed = np.array([True, True, False, False]), np.array([False, False, True, False])
    concepts = torch.zeros(4, len(CONCEPTS))
    concepts[:, LEAF] = 0.9
    concepts[:, APPLE] = torch.tensor([0.5, 0.4, 0.6, 0.1])
    features = torch.cat([concepts, torch.full((4, 11), 1 / 11)], dim=1).mul(0.5).sqrt()
    labels = np.where(fruit, APPLE, NOT_FRUIT).astype(np.uint8)
    pixels = Sample(features, labels, np.random.default_rng(0).random((4, 3)), fruit, missed, "apple")
    save_weights(
        tmp_path / "w.safetensors", Network(len(CONCEPTS)), Calibration(), widths=WIDTHS, depths=DEPTHS, seeds=[]
    )
    score = score_photos(EmbeddedEncoder.open(tmp_path / "w.safetensors"), [pixels])["apple"]
    assert score.ellipses.average_precision < 1.0 == score.seen.average_precision


def test_a_tiny_run_writes_weights_that_open_their_figures_and_a_card(
    photos: Path, renders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(train_encoder, "WIDTHS", (4, 4, 4, 4))
    monkeypatch.setattr(train_encoder, "DEPTHS", (0, 0, 0, 0))
    for name in ("a", "b"):
        train_encoder.train_encoder(
            train_encoder.Options(
                renders=renders, photos=photos, out=tmp_path / name / "w.safetensors", steps=2, batch=2, processes=1
            )
        )
    assert (tmp_path / "a" / "w.safetensors").read_bytes() == (tmp_path / "b" / "w.safetensors").read_bytes()
    document = json.loads((tmp_path / "a" / "w.json").read_text())
    assert document["seeds"] == list(range(1065, 1072))
    assert [run["steps"] for run in document["runs"]] == [2]
    assert set(document["measures"]["photos"]) == {"apple", "pear"}
    assert "apple" in (tmp_path / "a" / "MODEL_CARD.md").read_text()
    assert set(document["measures"]["conditions"]) == {"blurred", "mixed species"}
    assert set(document["measures"]["reliability"]) == {"photos"}  # one held-out scene cannot be fitted and judged
    assert EmbeddedEncoder.open(tmp_path / "a" / "w.safetensors").dimension == len(CONCEPTS) + len(COLOURS)


def _some_course(**changes: Any) -> Course:
    return Course(**{"steps": 3, "batch": 2, "seed": 5, "bf16": False, **changes})


def test_processes_that_share_gradients_learn_the_same_weights_each_time(photos: Path):
    pictures = read_photos(photos, "train")
    material = Material(pictures, [], cut_fruit(pictures))
    states = []
    for processes in (2, 2, 1):
        torch.manual_seed(0)
        network = Network(len(CONCEPTS), widths=(4, 4, 4, 4), depths=(0, 0, 0, 0))
        assert learn(network, material, _some_course(processes=processes)) == 3
        states.append(torch.cat([tensor.flatten().double() for tensor in network.state_dict().values()]))
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])  # the second process's crops were learnt from too


def test_a_run_by_the_clock_ends_in_all_processes(photos: Path):
    pictures = read_photos(photos, "train")
    network = Network(len(CONCEPTS), widths=(4, 4, 4, 4), depths=(0, 0, 0, 0))
    assert learn(network, Material(pictures, [], cut_fruit(pictures)), _some_course(minutes=0.03, processes=2)) >= 1


def test_a_larger_network_starts_with_the_answers_of_the_smaller_one(tmp_path: Path):
    torch.manual_seed(3)
    small = Network(len(CONCEPTS), widths=(4, 6, 8, 8), depths=(1, 1, 0, 1))
    path = tmp_path / "w.safetensors"
    save_weights(path, small, Calibration(), widths=(4, 6, 8, 8), depths=(1, 1, 0, 1), seeds=[], runs=[])
    large = Network(len(CONCEPTS), widths=(6, 6, 12, 16), depths=(2, 1, 1, 1))
    train_encoder.resume(large, path)
    image = torch.randn(1, 3, 48, 64)
    with torch.inference_mode():
        assert torch.allclose(large.eval()(image), read_weights(path).network().eval()(image), atol=1e-5)
    assert large.down[1][0].conv.weight[:, 4:].any() or large.down[0][0].conv.weight[4:].any()  # new ones are free
    with pytest.raises(EncoderError, match="larger network"):
        train_encoder.resume(Network(len(CONCEPTS), widths=(4, 4, 4, 4), depths=(0, 0, 0, 0)), path)


def test_half_of_the_crops_show_a_word_drawn_alike_however_few_its_pixels():
    labels = np.full((600, 600), LEAF, np.uint8)
    labels[300:306, 300:306] = CONCEPTS.index("tag")
    picture = Picture(np.zeros((600, 600, 3), np.uint8), labels, "scene")
    rng = np.random.default_rng(0)
    share = np.mean([(_crop(picture, rng, (1.9, 2.1), focus=0.5).labels != LEAF).any() for _ in range(200)])
    assert 0.22 < share < 0.45  # a quarter by focus, some by chance


def test_a_later_run_keeps_what_the_earlier_one_saw(tmp_path: Path):
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    path = tmp_path / "w.safetensors"
    save_weights(path, network, Calibration(), widths=WIDTHS, depths=DEPTHS, seeds=[1000], runs=[{"steps": 3}])
    past = train_encoder.resume(network, path)
    assert (past.runs, past.seeds) == ([{"steps": 3}], [1000])


def test_a_new_word_starts_at_random_and_the_known_ones_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "w.safetensors"
    with monkeypatch.context() as earlier:
        earlier.setattr("fruitlangs.engine.language.encoders.embedded.CONCEPTS", ("leaf", "apple", "moss"))
        old = Network(3)
        save_weights(path, old, Calibration(), widths=WIDTHS, depths=DEPTHS, seeds=[], runs=[])
    network = Network(len(CONCEPTS))
    fresh = network.head.weight[CONCEPTS.index("sky")].clone()
    train_encoder.resume(network, path)
    assert torch.allclose(network.head.weight[APPLE], old.head.weight[1], atol=1e-3)
    assert torch.allclose(network.down[0][0].conv.weight, old.down[0][0].conv.weight, atol=1e-3)
    assert torch.equal(network.head.weight[CONCEPTS.index("sky")], fresh)


def test_weights_that_do_not_record_their_scenes_are_no_start(tmp_path: Path):
    network = Network(len(CONCEPTS), widths=WIDTHS, depths=DEPTHS)
    path = tmp_path / "w.safetensors"
    save_weights(path, network, Calibration(), widths=WIDTHS, depths=DEPTHS, runs=[])
    with pytest.raises(EncoderError, match="do not record the seeds behind them"):
        train_encoder.resume(network, path)


def test_random_weights_are_never_written(photos: Path, tmp_path: Path):
    for nothing, message in (
        ({"steps": 0}, "name them by --start"),
        ({"steps": -1}, "--steps -1: give at least 0"),
        ({"minutes": 0.0}, "--minutes 0: give more than 0"),
        ({"minutes": float("nan")}, "--minutes nan: give more than 0"),
        ({"processes": 0}, "--processes 0: give at least 1"),
        ({"batch": 0}, "--batch 0: give at least 1"),
        ({"rate": 0.0}, "--rate 0: give more than 0"),
    ):
        with pytest.raises(ConfigError, match=message):
            train_encoder.train_encoder(train_encoder.Options(photos=photos, out=tmp_path / "w.safetensors", **nothing))
    assert not any(tmp_path.iterdir())


def test_a_run_must_name_where_its_weights_go(photos: Path):
    with pytest.raises(TypeError, match="out"):
        train_encoder.Options(photos=photos)  # type: ignore[call-arg]
