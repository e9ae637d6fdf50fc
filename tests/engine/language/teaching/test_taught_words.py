"""Names and files of taught words, and what prompts with them find."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from taught_words import feature_of, features_with, small_encoder, word_of

from fruitlangs.engine.errors import EncoderError, FormatError, VocabularyError
from fruitlangs.engine.language.encoders.clip import ClipEncoder
from fruitlangs.engine.language.encoders.encoder import TaughtQuestion
from fruitlangs.engine.language.prompts.relevancy import LEAST_PRIOR, answer, relevancy
from fruitlangs.engine.language.taught import word as word_module
from fruitlangs.engine.language.taught.library import Library, word_file
from fruitlangs.engine.language.taught.name import word_name
from fruitlangs.engine.language.taught.word import TENSORS, TaughtWord, read_word, save_word
from fruitlangs.engine.language.vocabulary import FRUIT_COLOURS, FRUITS, find_taught_name, parse
from fruitlangs.engine.storage.files import read_tensors, write_tensors

FIG, RED_FIG, LEAF = feature_of("purple", plum=0.5), feature_of("red", plum=0.5), feature_of("green", leaf=0.9)
IS_FIG = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
TREE = features_with(torch.stack([FIG, RED_FIG, LEAF]), IS_FIG)
"""A purple fig, a red fig and a leaf; the first number of the embedding says what is a fig."""


@pytest.fixture
def fig() -> TaughtWord:
    return word_of("fig", 10.0, 0.0, bias=-5.0)


@pytest.mark.parametrize(
    ("text", "name"),
    [("fig", "fig"), ("  Fig ", "fig"), ("Cherry   Tomato", "cherry tomato"), ("cherry-tomato", "cherry tomato"),
     ("Kaktusfeige", "kaktusfeige"), ("Açaí", "acai"), ("хурма", "хурма"), ("Dragon Fruit", "dragon fruit"),
     ("the fig", "fig"), ("cherry plum", "cherry plum")],
)  # fmt: skip
def test_a_name_is_folded_and_may_have_several_words(text: str, name: str) -> None:
    assert word_name(text) == name


@pytest.mark.parametrize(
    ("text", "word"),
    [("Pomme", "apple"), ("apples", "apple"), ("Zwetschge", "plum"), ("apple fruit", "apple"), ("l'orange", "orange"),
     ("naranja", "orange"), ("Blatt", "leaf")],
)  # fmt: skip
def test_a_name_of_a_built_in_word_becomes_that_word(text: str, word: str) -> None:
    assert word_name(text) == word


@pytest.mark.parametrize(
    ("text", "said"),
    [("the", "no meaning of its own"), ("une", "no meaning of its own"), ("red", "'red' describes"),
     ("red fig", "'red' describes"), ("fig rouge", "'rouge' describes"), ("ripe", "'ripe' describes"),
     ("unripe fig", "'unripe' describes"), ("plant", "Teach one of leaf, branch"), ("Obst", "Teach one of apple"),
     ("citrus fruit", "Teach one of lemon, orange"), ("../fig", "Use letters only"), ("a/b", "Use letters only"),
     ("a\\b", "Use letters only"), ("C:fig", "Use letters only"), ("fig.", "Use letters only"),
     ("fig2", "Use letters only"), ("12", "Use letters only"), ("fig\x00", "Use letters only"), ("", "Use letters"),
     ("_fig", "Use letters only"), ("-fig", "Use letters only"), ("e" * 41, "at most 40"),
     ("sea-buck-thorn-berry", "to 3 words"), ("ß" * 30, "at most 40"), ("orange fig", "'orange' describes")],
)  # fmt: skip
def test_what_cannot_be_a_name_is_refused(text: str, said: str) -> None:
    with pytest.raises(VocabularyError, match=said):
        word_name(text)


@pytest.mark.parametrize("text", ["con", "Nul", "AUX", "prn"])
def test_the_name_of_a_device_of_windows_is_no_name_of_a_word(text: str) -> None:
    with pytest.raises(VocabularyError, match=f"'{text}' is the name of a device on Windows"):
        word_name(text)
    assert word_name(f"{text} melon") == f"{text.casefold()} melon"


@pytest.mark.parametrize(
    "text",
    ["Fig", "Cherry-Tomato", "the  Açaí", "ﬁg", "fig's", "Pommes", "pe\u0302che de vigne", "केला"],
)  # fmt: skip
def test_a_word_can_be_read_under_the_name_that_it_was_given(text: str, tmp_path: Path) -> None:
    path = word_file(tmp_path, word_name(text))
    save_word(path, word_of(word_name(text), 1.0))
    assert Library.of(tmp_path, "test")[word_name(text)].name == word_name(text)


def test_a_word_that_is_written_is_read(tmp_path: Path, fig: TaughtWord) -> None:
    save_word(tmp_path / "fig.fruitword", fig)
    read = read_word(tmp_path / "fig.fruitword")
    for name in TENSORS:
        assert torch.equal(getattr(read, name), getattr(fig, name))
        assert getattr(read, name).dtype == getattr(fig, name).dtype
    for name in ("name", "encoder_id", "bias", "examples", "notes", "licence", "identity"):
        assert getattr(read, name) == getattr(fig, name)
    assert [path.name for path in tmp_path.iterdir()] == ["fig.fruitword"]


def test_equal_words_have_equal_files(tmp_path: Path, fig: TaughtWord) -> None:
    save_word(tmp_path / "one", fig)
    save_word(tmp_path / "other", read_word(tmp_path / "one"))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_the_identity_of_a_word_changes_with_its_answers_and_not_with_its_notes(fig: TaughtWord) -> None:
    assert replace(fig, notes="other").identity == fig.identity
    others = (replace(fig, bias=-4.0), replace(fig, weights=fig.weights * 2), replace(fig, name="kiwi"))
    assert len({fig.identity, *(other.identity for other in others)}) == 4


@pytest.mark.parametrize("kept", [0, 7, 100, -1])
def test_a_truncated_word_is_refused(tmp_path: Path, fig: TaughtWord, kept: int) -> None:
    path = tmp_path / "fig.fruitword"
    save_word(path, fig)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(FormatError, match="holds no taught word"):
        read_word(path)


def test_what_is_no_word_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fig.fruitword"
    with pytest.raises(FormatError, match="holds no taught word"):
        read_word(path)
    path.mkdir()
    with pytest.raises(FormatError, match="holds no taught word"):
        read_word(path)


def test_a_safetensors_file_of_another_kind_is_refused(tmp_path: Path, fig: TaughtWord) -> None:
    path = tmp_path / "fig.fruitword"
    write_tensors(path, {"weights": fig.weights}, {"format": "fruitlangs-features-2"})
    with pytest.raises(FormatError, match="it holds fruitlangs-features-2"):
        read_word(path)
    from safetensors.torch import save_file

    save_file({"weights": fig.weights}, path)
    with pytest.raises(FormatError, match="holds no taught word"):
        read_word(path)


@pytest.mark.parametrize(
    ("said", "tensors"),
    [
        ("do not fit", {"weights": torch.zeros(2, dtype=torch.float64)}),
        ("do not fit", {"weights": torch.zeros(3)}),
        ("do not fit", {"weights": torch.zeros(1, 2)}),
        ("do not fit", {"vectors": torch.zeros(2, 2)}),
        ("do not fit", {"vectors": torch.zeros(0, 2, dtype=torch.float16)}),
        ("do not fit", {"positive": torch.ones(2, dtype=torch.uint8)}),
        ("do not fit", {"positive": torch.ones(3, dtype=torch.bool)}),
        ("do not fit", {"prior": torch.zeros(2, dtype=torch.float16)}),
        ("do not fit", {"groups": torch.zeros(2, dtype=torch.int32)}),
        ("do not fit", {"thumbnails": torch.zeros(1, 8, 8, 3, dtype=torch.uint8)}),
        ("do not fit", {"thumbnails": torch.zeros(1, 64, 64, 3)}),
        ("belongs to no example", {"groups": torch.tensor([0, 2])}),
        ("belongs to no example", {"groups": torch.tensor([-1, 0])}),
        ("not finite", {"weights": torch.tensor([0.0, torch.nan])}),
        ("not finite", {"vectors": torch.full((2, 2), torch.inf, dtype=torch.float16)}),
        ("not finite", {"prior": torch.tensor([0.0, -torch.inf])}),
    ],
)
def test_tensors_that_do_not_fit_are_refused(
    tmp_path: Path, fig: TaughtWord, said: str, tensors: dict[str, torch.Tensor]
) -> None:
    path = tmp_path / "fig.fruitword"
    save_word(path, replace(fig, **tensors))
    with pytest.raises(FormatError, match=said):
        read_word(path)


@pytest.mark.parametrize(
    ("said", "entries"),
    [
        ("cannot be the name", {"name": "../../fig"}),
        ("cannot be the name", {"name": "fig\x00"}),
        ("cannot be the name", {"name": ""}),
        ("cannot be the name", {"name": {"fig": 1}}),
        ("name", {"name": "Fig"}),
        ("name", {"name": "pomme"}),
        ("describes", {"name": "red"}),
        ("not finite", {"bias": float("nan")}),
        ("not finite", {"bias": 1e300}),
        ("holds no taught word", {"bias": 10**400}),
        ("holds no taught word", {"bias": None}),
        ("holds no taught word", {"examples": 3}),
        ("holds no taught word", {"examples": ["IMG_1.jpg:1,2"]}),
        ("holds no taught word", {"examples": [{"positive": True, "place": "a", "gaussians": "many"}] * 2}),
        ("belongs to no example", {"examples": []}),
        ("it holds fruitlangs-word-9", {"format": "fruitlangs-word-9"}),
    ],
)
def test_a_header_that_does_not_fit_is_refused(
    tmp_path: Path, fig: TaughtWord, said: str, entries: dict[str, Any]
) -> None:
    path = tmp_path / "fig.fruitword"
    save_word(path, fig)
    tensors, header = read_tensors(path)
    write_tensors(path, tensors, {**header, **entries})
    with pytest.raises(FormatError, match=said):
        read_word(path)


def test_a_header_that_is_nested_deeply_is_refused(tmp_path: Path, fig: TaughtWord) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "fig.fruitword"
    save_file({"weights": fig.weights}, path, metadata={"fruitlangs": "[" * 200_000})
    with pytest.raises(FormatError, match="holds no taught word"):
        read_word(path)


@pytest.mark.parametrize("missing", [*TENSORS, "name", "encoder_id", "bias", "examples", "notes", "licence", "format"])
def test_a_word_without_a_part_is_refused(tmp_path: Path, fig: TaughtWord, missing: str) -> None:
    path = tmp_path / "fig.fruitword"
    save_word(path, fig)
    tensors, header = read_tensors(path)
    for content in (tensors, header):
        content.pop(missing, None)
    write_tensors(path, tensors, header)
    with pytest.raises(FormatError, match=f"holds no taught word.*{missing}"):
        read_word(path)


def test_a_file_that_is_too_large_is_refused_unread(
    tmp_path: Path, fig: TaughtWord, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "fig.fruitword"
    save_word(path, fig)
    monkeypatch.setattr(word_module, "LARGEST_FILE", path.stat().st_size)
    assert read_word(path).name == "fig"
    monkeypatch.setattr(word_module, "LARGEST_FILE", path.stat().st_size - 1)
    monkeypatch.setattr(word_module, "read_tensors", lambda _: pytest.fail("it was read"))
    with pytest.raises(FormatError, match="larger than"):
        read_word(path)


def test_more_vectors_than_a_word_may_have_are_refused(
    tmp_path: Path, fig: TaughtWord, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_word(tmp_path / "fig.fruitword", fig)
    monkeypatch.setattr(word_module, "MOST_VECTORS", 1)
    with pytest.raises(FormatError, match="do not fit"):
        read_word(tmp_path / "fig.fruitword")


def test_the_words_of_a_folder_are_found_by_the_names_of_their_files(tmp_path: Path, fig: TaughtWord) -> None:
    save_word(word_file(tmp_path, "fig"), fig)
    save_word(word_file(tmp_path, "cherry tomato"), word_of("cherry tomato", 1.0, 1.0))
    (tmp_path / "notes.txt").write_text("kiwi")
    library = Library.of(tmp_path, "test")
    assert sorted(library) == ["cherry tomato", "fig"]
    assert library["cherry tomato"].name == "cherry tomato"
    assert "kiwi" not in library
    assert len(Library.of(tmp_path / "none", "test")) == 0


def test_a_damaged_word_matters_only_when_it_is_asked_for(tmp_path: Path, fig: TaughtWord) -> None:
    save_word(word_file(tmp_path, "fig"), fig)
    word_file(tmp_path, "kiwi").write_bytes(b"nothing")
    encoder = small_encoder().with_words(Library.of(tmp_path, "test"))
    assert relevancy(TREE, encoder, ["fig"]).argmin() == 2
    assert float(relevancy(TREE, encoder, ["leaf"])[2]) > 0.5
    with pytest.raises(FormatError, match=r"kiwi\.fruitword"):
        relevancy(TREE, encoder, ["kiwi"])
    with pytest.raises(FormatError, match=r"kiwi\.fruitword"):
        relevancy(TREE, encoder, ["fig"], ["kiwi"])


def test_a_file_with_the_name_of_another_word_is_refused(tmp_path: Path, fig: TaughtWord) -> None:
    save_word(word_file(tmp_path, "kiwi"), fig)
    with pytest.raises(FormatError, match="holds the word 'fig'"):
        Library.of(tmp_path, "test")["kiwi"]


def test_a_word_that_was_taught_with_another_encoder_is_refused(tmp_path: Path, fig: TaughtWord) -> None:
    save_word(word_file(tmp_path, "fig"), replace(fig, encoder_id="another"))
    with pytest.raises(EncoderError, match="taught with the encoder another, not with test"):
        Library.of(tmp_path, "test")["fig"]


def test_a_word_for_longer_evidence_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises((EncoderError, FormatError), match="Teach it again"):
        relevancy(TREE, small_encoder(word_of("fig", 1.0, 1.0, 1.0)), ["fig"])


@pytest.mark.parametrize(
    "stray",
    ["Fig 2", "fig.old", ".fig", "red", "-"],
)
def test_a_file_whose_name_is_no_word_stops_no_other_prompt(tmp_path: Path, fig: TaughtWord, stray: str) -> None:
    save_word(word_file(tmp_path, "fig"), fig)
    (tmp_path / f"{stray}.fruitword").write_bytes(b"nothing")
    encoder = small_encoder().with_words(Library.of(tmp_path, "test"))
    assert torch.equal(relevancy(TREE, encoder, ["red fig"]), relevancy(TREE, small_encoder(fig), ["red fig"]))


@pytest.mark.parametrize("prompt", ["fig", "figs", "Figs", " the FIG ", "fig fruit"])
def test_a_taught_word_is_found_in_any_spelling(fig: TaughtWord, prompt: str) -> None:
    found = relevancy(TREE, small_encoder(fig), [prompt])
    expected = torch.sigmoid(torch.tensor([5.0, 5.0, -5.0]))
    assert torch.allclose(found, expected, atol=1e-4)


def test_colours_and_ripeness_combine_with_taught_words(fig: TaughtWord) -> None:
    encoder = small_encoder(fig)
    one = features_with(torch.stack([FIG, feature_of("green", plum=0.5), LEAF]), IS_FIG)
    purple, green, leaf = relevancy(one, encoder, ["Ripe fig"]).tolist()
    assert purple > 0.95
    assert max(green, leaf) < 0.05
    purple, red, leaf = relevancy(TREE, encoder, ["red figs"]).tolist()
    assert red > 0.95
    assert max(purple, leaf) < 0.05


def test_the_colours_of_a_taught_word_are_those_of_fruit(fig: TaughtWord) -> None:
    seen = features_with(torch.stack([0.5 * FIG**2 + 0.5 * feature_of("black", plum=0.5) ** 2]).sqrt(), IS_FIG[:1])
    assert float(relevancy(seen, small_encoder(fig), ["purple fig"])) > 0.9
    assert float(relevancy(seen, small_encoder(fig), ["black fig"])) == pytest.approx(0.5, abs=0.02)


def test_a_taught_negative_takes_its_share_away(fig: TaughtWord) -> None:
    encoder = small_encoder(fig)
    before = relevancy(TREE, encoder, ["plum"])
    after = relevancy(TREE, encoder, ["plum"], ["figs"])
    assert torch.allclose(after, before * (1.0 - relevancy(TREE, encoder, ["fig"])), atol=1e-5)
    assert (
        float(relevancy(TREE, encoder, ["fig"], ["red fig"])[1])
        < 0.05
        < 0.95
        < float(relevancy(TREE, encoder, ["fig"], ["red fig"])[0])
    )


def test_a_taught_word_that_a_negative_rules_out_is_refused(fig: TaughtWord) -> None:
    with pytest.raises(VocabularyError, match="is excluded by"):
        relevancy(TREE, small_encoder(fig), ["red fig"], ["Figs"])


def test_several_words_that_were_taught_as_one_are_one_noun() -> None:
    taught = ("cherry tomato", "fig")
    phrase = parse("red Cherry-Tomatoes", taught)
    assert (phrase.text, phrase.noun, phrase.colours) == ("red cherry tomato", "cherry tomato", ("red",))
    assert parse("cherries", taught).noun == "cherry"
    with pytest.raises(VocabularyError, match="'tomato'"):
        parse("tomato", taught)
    with pytest.raises(VocabularyError, match="more than one object"):
        parse("cherry tomato fig", taught)


def test_the_longest_taught_name_is_meant() -> None:
    taught = ("passion", "passion fruit tree", "passion fruit")
    assert parse("passion fruits", taught).noun == "passion fruit"
    assert parse("passion", taught).noun == "passion"


def test_a_taught_word_and_another_object_are_two_objects() -> None:
    for prompt in ("fig leaf", "fig apple", "fig plant"):
        with pytest.raises(VocabularyError, match="more than one object"):
            parse(prompt, ("fig",))


def test_an_unknown_word_is_refused_with_the_taught_names(fig: TaughtWord) -> None:
    with pytest.raises(VocabularyError, match=r"'figg'.*nearest known: fig.*it knows apple.*, fig,"):
        relevancy(TREE, small_encoder(fig), ["figg"])
    with pytest.raises(VocabularyError, match="it knows apple") as refused:
        relevancy(TREE, small_encoder(), ["fig"])
    assert "tool, fig" not in str(refused.value)


def test_a_taught_word_of_a_built_in_name_refines_it() -> None:
    apple = word_of("apple", 2.0, -3.0, bias=0.5)
    tree = features_with(torch.stack([feature_of("red", apple=0.7), LEAF]), torch.tensor([[0.5, 0.0], [0.0, 0.25]]))
    built_in = relevancy(tree, small_encoder(), ["apple"])
    refined = relevancy(tree, small_encoder(apple), ["Pomme"])
    prior = torch.logit(built_in, eps=LEAST_PRIOR)
    assert torch.allclose(refined, torch.sigmoid(prior + torch.tensor([1.5, -0.25])), atol=1e-4)
    assert apple.refines
    assert not word_of("fig", 1.0).refines


def test_examples_can_correct_a_built_in_word_however_certain_it_is() -> None:
    vectors = torch.stack([feature_of("red", apple=1.0), feature_of("green", leaf=1.0)])
    asked = [TaughtQuestion(word_of("apple", 8.0, 0.0, bias=-4.0), small_encoder().questions("apple"))]
    wrong, right = answer(vectors, asked, torch.tensor([[-1.0, 0.0], [2.0, 0.0]])).tolist()
    assert wrong < 0.01
    assert right > 0.99


def test_a_word_that_refines_an_apple_leaves_other_fruit_as_it_was() -> None:
    apple = word_of("apple", 2.0, -3.0, bias=5.0)
    for prompt in ("pear", "plum", "fruit", "leaf"):
        found, before = (relevancy(TREE, encoder, [prompt]) for encoder in (small_encoder(apple), small_encoder()))
        assert torch.equal(found, before)


def test_features_without_an_embedding_know_built_in_words_only(fig: TaughtWord) -> None:
    earlier = replace(TREE, embedding=None)
    assert float(relevancy(earlier, small_encoder(fig), ["leaf"])[2]) > 0.5
    with pytest.raises(EncoderError, match="earlier version"):
        relevancy(earlier, small_encoder(fig), ["fig"])
    with pytest.raises(EncoderError, match="earlier version"):
        relevancy(earlier, small_encoder(fig), ["leaf"], ["fig"])


def test_a_hardly_seen_gaussian_has_probability_zero_of_a_taught_word(fig: TaughtWord) -> None:
    assert not relevancy(replace(TREE, weights=TREE.weights * 0.01), small_encoder(fig), ["fig"]).any()


def test_a_taught_word_and_a_fruit_add_and_a_synonym_adds_nothing(fig: TaughtWord) -> None:
    encoder = small_encoder(replace(fig, weights=torch.tensor([0.1, 0.0]), bias=-1.5))
    alone, plum = (relevancy(TREE, encoder, [word]) for word in ("fig", "plum"))
    assert torch.allclose(relevancy(TREE, encoder, ["fig", "plum"]), (alone + plum).clamp_max(1.0), atol=1e-5)
    assert torch.equal(relevancy(TREE, encoder, ["fig", "Figs", "the fig"]), alone)


@pytest.mark.parametrize(
    ("prompt", "label"),
    [("Figs", "fig"), ("RED figs", "red fig"), ("Cherry-Tomatoes", "cherry tomato"), ("Pommes", "apple")],
)
def test_the_label_of_fruit_is_its_word_in_the_singular(prompt: str, label: str) -> None:
    assert small_encoder(word_of("fig", 1.0), word_of("cherry tomato", 1.0)).label(prompt) == label


def test_clip_has_labels_for_words_that_only_it_knows(fig: TaughtWord) -> None:
    encoder: Any = ClipEncoder(None, 4, {"fig": fig})  # type: ignore[arg-type]
    assert encoder.label("Ripe Figs") == "ripe fig"
    assert encoder.label("Golf  Balls") == "golf balls"


def test_clip_asks_a_taught_word_where_the_prompt_says_nothing_else(fig: TaughtWord) -> None:
    encoder = ClipEncoder(None, 4).with_words({"fig": fig})  # type: ignore[arg-type]
    (question,) = encoder.questions("the Figs")
    assert isinstance(question, TaughtQuestion)
    assert question.word is fig
    assert encoder.meaning("FIGS") == encoder.meaning("fig")
    assert find_taught_name("red fig", ["fig"]) == ""


def test_colours_choose_among_fruit_of_a_taught_word(fig: TaughtWord) -> None:
    encoder = small_encoder(fig)
    split = encoder.split_colours(["red figs", "green fig"], ["leaf", "green"])
    assert split is not None
    assert (split.prompts, split.negatives, split.kinds) == (("fig",), ["leaf"], ("fig",))
    assert [word for word, asked in zip(split.words, split.asked, strict=True) if asked] == ["red"]
    assert tuple(split.words) == FRUIT_COLOURS
    assert encoder.split_colours(["fig"], []) is None
    assert encoder.split_colours(["red fig", "red plum"], []) is None
    assert encoder.split_colours(["red leaf"], []) is None


def test_words_can_be_exchanged_and_the_encoder_stays_the_same(fig: TaughtWord) -> None:
    encoder = small_encoder(fig)
    other = encoder.with_words({"kiwi": word_of("kiwi", 1.0)})
    assert (list(encoder.taught), list(other.taught)) == (["fig"], ["kiwi"])
    assert other.identity == encoder.identity
    assert other.network is encoder.network
    assert set(FRUITS) & set(other.taught) == set()
