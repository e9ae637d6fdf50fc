"""The words that the embedded encoder knows, and how a prompt is parsed.

A prompt names at most one object, with any number of colours or a ripeness before or after it: "apple", "red apple",
"green", "unripe plum", "pomme rouge". Capitals, accents, spaces, hyphens, articles and plurals do not matter. Ripeness
is a colour and applies to fruit only: unripe fruit is green, ripe fruit has any other colour of fruit. "orange" alone
is the fruit; "orange apple" is a colour and a fruit.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from ..errors import VocabularyError
from . import words
from .words import by_name, fold

FRUITS = ("apple", "pear", "cherry", "plum", "lemon", "orange", "peach", "mango")
SURROUNDINGS = (
    *("leaf", "branch", "trunk", "flower", "hedge", "soil", "grass", "sky"),
    *("post", "tag", "bucket", "crate", "ladder", "stone", "wall", "object", "background"),
)
CONCEPTS = FRUITS + SURROUNDINGS
"""What a pixel can show; exactly one of them."""
COLOURS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "white", "grey", "black")
"""The colour of a pixel; exactly one of them."""
FRUIT_COLOURS = ("red", "orange", "yellow", "green", "blue", "purple", "pink")
"""Colours that people use for fruit: one in shade looks brown or black, but is called red."""

ANY_FRUIT = "fruit"
"""The word for fruit of any kind."""
GENERAL = {
    ANY_FRUIT: FRUITS,
    "citrus": ("lemon", "orange"),
    "plant": ("leaf", "branch", "trunk", "flower", "hedge", "grass"),
    "ground": ("soil", "grass"),
    "tool": ("bucket", "crate", "ladder"),
}
"""Words that stand for several concepts."""
_RIPE = {"unripe": ("green",), "ripe": tuple(colour for colour in FRUIT_COLOURS if colour != "green")}
_THINGS, _COLOUR_NAMES, _RIPENESS = by_name(words.THINGS), by_name(words.COLOURS), by_name(words.RIPENESS)


@dataclass(frozen=True)
class Phrase:
    """A parsed prompt: any of the colours (none: any) and any of the concepts (none: any), which `noun` names."""

    text: str
    colours: tuple[str, ...]
    concepts: tuple[str, ...]
    noun: str

    def within(self, other: Phrase) -> bool:
        """Whether everything that matches this phrase also matches `other`."""
        return _narrows(self.colours, other.colours) and _narrows(self.concepts, other.concepts)

    def excludes(self, other: Phrase) -> bool:
        """Whether nothing matches both phrases."""
        pairs = ((self.colours, other.colours), (self.concepts, other.concepts))
        return any(mine and theirs and not set(mine) & set(theirs) for mine, theirs in pairs)


def parse(prompt: str, taught: Collection[str] = ()) -> Phrase:
    """Parse a prompt. taught: folded names of words that a user taught, each of one or more words; they name an object
    as a noun does, and the longest name counts.

    Raises:
        VocabularyError: an unknown word (the message names the nearest known ones), no word, or more than one noun.
    """
    read = _merge_names(split(prompt), taught)
    if not read:
        raise VocabularyError(f"The prompt '{prompt}' has no word. Name a fruit, for example 'apple' or 'red apple'")

    def thing(word: str) -> str:
        return word if word in taught else _thing(word)

    for word in read:
        if not (thing(word) or _colour(word) or word in _RIPENESS):
            raise VocabularyError(_complaint(word, prompt, taught))
    things = [thing(word) for word in read]
    place = _find_noun(things, [bool(_colour(word)) for word in read], prompt)
    noun = (ANY_FRUIT if _RIPENESS.keys() & read else "") if place is None else things[place]
    named: list[str] = []
    ripeness: list[str] = []
    for i, word in enumerate(read):
        if i == place or (things[i] and not _colour(word)):  # a more general word, as in "apple fruit", adds nothing
            continue
        (ripeness if word in _RIPENESS else named).append(_RIPENESS.get(word) or _colour(word))
    adjectives = dict.fromkeys(named or ripeness[-1:])
    colours = dict.fromkeys(colour for word in adjectives for colour in _RIPE.get(word, (word,)))
    concepts = GENERAL.get(noun, (noun,)) if noun else ()
    return Phrase(" ".join([*adjectives, *([noun] if noun else [])]), tuple(colours), concepts, noun)


def split(prompt: str) -> list[str]:
    """The folded words of a prompt that mean something."""
    return [word for word in re.split(r"[\s\-_,'’]+", fold(prompt.strip())) if word and word not in words.FILLERS]


def find_taught_name(prompt: str, taught: Collection[str]) -> str:
    """Find the taught name that is all that a prompt says, also in the plural; empty if there is none."""
    read = _merge_names(split(prompt), taught)
    return read[0] if len(read) == 1 and read[0] in taught else ""


def list_words() -> tuple[str, ...]:
    """List every word that a prompt may contain, in all listed forms, nouns first."""
    return tuple(dict.fromkeys([*sorted(_THINGS), *sorted(_COLOUR_NAMES), *sorted(_RIPENESS)]))


def describes(word: str) -> bool:
    """Whether a folded word names a colour or a ripeness and no object."""
    return bool(_colour(word) or word in _RIPENESS) and not _thing(word)


def _merge_names(read: Sequence[str], taught: Collection[str]) -> list[str]:
    """Return the words of a prompt, with those that together are a taught name as one; it may be in the plural."""
    names = sorted((name.split() for name in taught), key=len, reverse=True)
    joined, at = [], 0
    while at < len(read):
        for name in names:
            part = list(read[at : at + len(name)])
            if part[:-1] == name[:-1] and set(singulars(name[-1])) & set(singulars(part[-1])):
                joined.append(" ".join(name))
                at += len(name)
                break
        else:
            joined.append(read[at])
            at += 1
    return joined


def _find_noun(nouns: Sequence[str], colours: Sequence[bool], prompt: str) -> int | None:
    """Find the place of the noun: the most specific; a word that may also be a colour only if there is no other. nouns:
    what each word names; colours: whether it may be a colour.

    Raises:
        VocabularyError: there are two nouns, and neither is a kind of the other.
    """
    sure = [i for i, noun in enumerate(nouns) if noun and not colours[i]]
    if not sure:
        either = [i for i, noun in enumerate(nouns) if noun]
        return either[-1] if either else None

    def meaning(i: int) -> frozenset[str]:
        return frozenset(GENERAL.get(nouns[i], (nouns[i],)))

    narrowest = min(sure, key=lambda i: len(meaning(i)))
    general = {ANY_FRUIT} if nouns[narrowest] not in (*CONCEPTS, *GENERAL) else set()  # a taught word is a fruit too
    if not all(meaning(narrowest) <= meaning(i) or nouns[i] in general for i in sure):
        raise VocabularyError(f"The prompt '{prompt}' names more than one object. Give each as a separate prompt")
    return narrowest


def _thing(word: str) -> str:
    """The meaning of a folded word, in the singular; empty if unknown."""
    return next((_THINGS[form] for form in singulars(word) if form in _THINGS), "")


def singulars(word: str) -> tuple[str, ...]:
    """What a folded word may be in the singular."""
    return (word, word.removesuffix("s"), word.removesuffix("es"))


def _colour(word: str) -> str:
    return _COLOUR_NAMES.get(word, "")


def _narrows(mine: tuple[str, ...], theirs: tuple[str, ...]) -> bool:
    return not theirs or (bool(mine) and set(mine) <= set(theirs))


def _complaint(word: str, prompt: str, taught: Collection[str]) -> str:
    nearest = difflib.get_close_matches(word, [*taught, *list_words()], n=3, cutoff=0.6)
    hint = f"nearest known: {', '.join(nearest)}; " if nearest else ""
    things = ", ".join([*CONCEPTS, *GENERAL, *taught])
    return (
        f"the encoder does not know the word '{word}' in the prompt '{prompt}'; {hint}it knows {things}, "
        f"their names in German, French and Spanish, and the colours {', '.join(COLOURS)}"
    )
