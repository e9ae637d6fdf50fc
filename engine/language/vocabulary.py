"""The words the embedded encoder knows, and how a prompt is read.

A prompt is any number of colours followed by at most one thing: "apple", "red apple", "green", "red fruit". Capitals,
blanks, hyphens, articles and plurals do not matter. "orange" alone is the fruit; "orange apple" is a colour and a
fruit.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass

from ..errors import VocabularyError

FRUITS = ("apple", "pear", "cherry", "plum", "lemon", "orange", "peach", "mango")
SURROUNDINGS = ("leaf", "branch", "trunk", "soil", "grass", "sky", "post", "background")
CONCEPTS = FRUITS + SURROUNDINGS
"""What a pixel can be; exactly one of them."""
COLOURS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "white", "grey", "black")
"""What a pixel can look like; exactly one of them."""
FRUIT_COLOURS = ("red", "orange", "yellow", "green", "blue", "purple", "pink")
"""What is said of fruit: one in shade is brown or black to look at, and red to speak of."""

_GENERAL = {"fruit": FRUITS, "plant": ("leaf", "branch", "trunk", "grass"), "ground": ("soil", "grass")}
_SYNONYMS = {
    "fruitlet": "fruit",
    "foliage": "leaf",
    "leafage": "leaf",
    "twig": "branch",
    "limb": "branch",
    "bough": "branch",
    "stem": "trunk",
    "bole": "trunk",
    "earth": "soil",
    "dirt": "soil",
    "lawn": "grass",
    "meadow": "grass",
    "cloud": "sky",
    "pole": "post",
    "stake": "post",
    "wall": "background",
    "floor": "background",
    "table": "background",
    "cloth": "background",
}
_PLURALS = {"leaves": "leaf", "branches": "branch", "cherries": "cherry", "peaches": "peach", "mangoes": "mango"}
_COLOUR_SYNONYMS = {
    "gray": "grey",
    "violet": "purple",
    "magenta": "purple",
    "crimson": "red",
    "scarlet": "red",
    "golden": "yellow",
    "rose": "pink",
}
_FILLERS = frozenset({"a", "an", "the"})


@dataclass(frozen=True)
class Phrase:
    """A prompt as it was understood: any of the colours (none named: any) and any of the concepts (none: any)."""

    text: str
    colours: tuple[str, ...]
    concepts: tuple[str, ...]

    def within(self, other: Phrase) -> bool:
        """Whether everything that satisfies this phrase satisfies `other` too."""
        return _narrows(self.colours, other.colours) and _narrows(self.concepts, other.concepts)


def parse(prompt: str) -> Phrase:
    """Read a prompt.

    Raises:
        VocabularyError: an unknown word (the message names the nearest known ones), no word, or more than one thing.
    """
    words = [word for word in re.split(r"[\s\-_,]+", prompt.casefold().strip()) if word and word not in _FILLERS]
    if not words:
        raise VocabularyError(f"the prompt '{prompt}' holds no word; name a fruit, for example 'apple' or 'red apple'")
    *adjectives, last = words
    noun = _noun(last)
    if noun is None:
        adjectives, last = words, ""
    for word in adjectives:
        if _colour(word) is None:
            raise VocabularyError(_complaint(word, prompt))
    colours = tuple(dict.fromkeys(colour for word in adjectives if (colour := _colour(word)) is not None))
    concepts = () if noun is None else _GENERAL.get(noun, (noun,))
    text = " ".join([*colours, *([noun] if noun else [])])
    return Phrase(text, colours, concepts)


def known_words() -> tuple[str, ...]:
    """Every word a prompt may hold, in the singular, things first."""
    things = sorted({*CONCEPTS, *_GENERAL, *_SYNONYMS})
    return (*things, *sorted({*COLOURS, *_COLOUR_SYNONYMS} - {*things}))


def _noun(word: str) -> str | None:
    for form in (word, _PLURALS.get(word, ""), word.removesuffix("s"), word.removesuffix("es")):
        if form in _GENERAL or form in CONCEPTS:
            return form
        if form in _SYNONYMS:
            return _SYNONYMS[form]
    return None


def _colour(word: str) -> str | None:
    word = _COLOUR_SYNONYMS.get(word, word)
    return word if word in COLOURS else None


def _narrows(mine: tuple[str, ...], theirs: tuple[str, ...]) -> bool:
    return not theirs or (bool(mine) and set(mine) <= set(theirs))


def _complaint(word: str, prompt: str) -> str:
    if _noun(word) is not None:
        return f"the prompt '{prompt}' names more than one thing; give each as a prompt of its own"
    nearest = difflib.get_close_matches(word, known_words(), n=3, cutoff=0.5)
    hint = f"nearest known: {', '.join(nearest)}" if nearest else f"known fruit: {', '.join(FRUITS)}"
    return (
        f"the encoder does not know the word '{word}' in the prompt '{prompt}'; {hint}; "
        f"all words: {', '.join(known_words())}"
    )
