"""Prompts are read as colours and one noun; anything else is refused with a hint."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import pytest

from fruitlangs.engine.errors import VocabularyError
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS, FRUIT_COLOURS, FRUITS, list_words, parse
from fruitlangs.engine.language.words import COLOURS as COLOUR_NAMES
from fruitlangs.engine.language.words import FILLERS, RIPENESS, THINGS, fold


def test_capitals_blanks_plurals_and_articles_do_not_matter():
    expected = parse("red apple")
    for prompt in ("  Red   APPLES ", "red-apple", "a red apple", "the red apples"):
        assert parse(prompt) == expected


@pytest.mark.parametrize("word", [*CONCEPTS, *COLOURS])
def test_every_word_of_the_vocabulary_is_read(word: str):
    phrase = parse(word)
    assert (*phrase.concepts, *phrase.colours) == (word,)


@pytest.mark.parametrize(
    ("plural", "singular"),
    [("cherries", "cherry"), ("leaves", "leaf"), ("peaches", "peach"), ("mangoes", "mango"), ("mangos", "mango"),
     ("branches", "branch"), ("posts", "post"), ("oranges", "orange"), ("twigs", "branch"), ("foliage", "leaf")],
)  # fmt: skip
def test_plurals_and_synonyms_mean_the_same_word(plural: str, singular: str):
    assert parse(plural).concepts == (singular,)


def test_fruit_means_any_of_the_fruit():
    assert parse("green fruit").concepts == FRUITS
    assert parse("fruits").colours == ()


def test_orange_is_the_fruit_unless_it_describes_one():
    assert parse("orange") == parse("oranges")
    assert parse("orange").concepts == ("orange",)
    assert parse("orange apple").colours == ("orange",)
    assert parse("orange apple").concepts == ("apple",)
    assert parse("orange orange").colours == ("orange",)


def test_an_unknown_word_is_refused_with_the_nearest_known_ones():
    with pytest.raises(VocabularyError, match=r"'aple'.*nearest known: apple"):
        parse("red aple")
    with pytest.raises(VocabularyError, match=r"'tractor'.*it knows apple, pear"):
        parse("tractor")


def test_an_unknown_adjective_is_refused_by_its_name():
    with pytest.raises(VocabularyError, match="'shiny'"):
        parse("shiny apple")


def test_two_objects_in_one_prompt_are_refused():
    with pytest.raises(VocabularyError, match="more than one object"):
        parse("apple leaf")


@pytest.mark.parametrize("prompt", ["", "   ", "the"])
def test_an_empty_prompt_is_refused(prompt: str):
    with pytest.raises(VocabularyError, match="no word"):
        parse(prompt)


def test_a_phrase_is_within_every_wider_one():
    assert parse("red apple").within(parse("apple"))
    assert parse("apple").within(parse("fruit"))
    assert parse("red apple").within(parse("red"))
    assert not parse("apple").within(parse("red apple"))
    assert not parse("fruit").within(parse("apple"))
    assert not parse("red").within(parse("apple"))


def test_a_narrower_word_next_to_a_wider_one_is_what_is_meant():
    assert parse("apple fruit") == parse("apple")
    assert parse("citrus fruit").concepts == ("lemon", "orange")


@pytest.mark.parametrize(
    ("prompt", "english"),
    [("Äpfel", "apple"), ("rote Äpfel", "red apple"), ("pomme rouge", "red apple"), ("les cerises", "cherry"),
     ("l'orange", "orange"), ("manzanas verdes", "green apple"), ("naranja verde", "green orange"), ("Obst", "fruit"),
     ("unreife Zwetschgen", "unripe plum"), ("pêches mûres", "ripe peach"), ("limón amarillo", "yellow lemon"),
     ("süßkirsche", "cherry"), ("Mangos", "mango"), ("poires", "pear")],
)  # fmt: skip
def test_german_french_and_spanish_names_mean_the_english_ones(prompt: str, english: str):
    assert parse(prompt) == parse(english)


def test_unripe_fruit_is_green_and_ripe_fruit_has_another_colour_of_fruit():
    assert parse("unripe plum").colours == ("green",)
    assert set(parse("ripe plum").colours) == set(FRUIT_COLOURS) - {"green"}
    assert parse("unripe").concepts == FRUITS
    assert parse("ripe green apple") == parse("green apple")
    assert parse("ripe plum").text == "ripe plum"


def test_no_name_has_two_meanings_but_orange():
    names = [
        name
        for table in (THINGS, COLOUR_NAMES, RIPENESS)
        for meaning, others in table.items()
        for name in {meaning, *others.split()}
    ]
    assert {name for name, count in Counter(names).items() if count > 1} == {"orange", "naranja"}
    assert len(set(names)) >= 150
    assert not FILLERS & set(names)


@pytest.mark.parametrize("table", [THINGS, COLOUR_NAMES, RIPENESS])
def test_names_are_listed_as_prompts_are_folded(table: Mapping[str, str]):
    for names in table.values():
        assert [fold(name) for name in names.split()] == names.split()


def test_known_words_are_all_read():
    for word in list_words():
        parse(word)
