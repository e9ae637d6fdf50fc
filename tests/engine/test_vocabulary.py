"""Prompts are read as colours and one thing; anything else is refused with a hint."""

from __future__ import annotations

import pytest

from fruitlangs.engine.errors import VocabularyError
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS, FRUITS, known_words, parse


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
    with pytest.raises(VocabularyError, match=r"'tractor'.*all words: .*pear"):
        parse("tractor")


def test_an_unknown_adjective_is_refused_by_its_name():
    with pytest.raises(VocabularyError, match="'ripe'"):
        parse("ripe apple")


def test_two_things_in_one_prompt_are_refused():
    with pytest.raises(VocabularyError, match="more than one thing"):
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


def test_known_words_are_all_read():
    for word in known_words():
        parse(word)
