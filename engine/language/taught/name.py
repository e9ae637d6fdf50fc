"""Names of taught words."""

from __future__ import annotations

import unicodedata

from ...errors import VocabularyError
from ...storage.files import names_device
from ..vocabulary import COLOURS, CONCEPTS, GENERAL, describes, parse, split

MOST_LETTERS, MOST_WORDS = 40, 3
"""Longest name."""
_BETWEEN = " '’-"
"""What may stand between letters."""


def word_name(text: str) -> str:
    """The name under which a word is taught: folded, "Cherry Tomato" → "cherry tomato".

    A name of a built-in word becomes that word, whatever its language: to teach "Pomme" refines "apple".

    Raises:
        VocabularyError: it cannot be a name, because it has other characters than letters, describes a fruit instead of
            naming one, stands for several objects, or cannot name a file.
    """
    spelled = unicodedata.normalize("NFC", " ".join(text.split()))
    folded = split(spelled)
    if not _is_spelled(spelled) or len(" ".join(folded)) > MOST_LETTERS or len(folded) > MOST_WORDS:
        raise VocabularyError(
            f"'{text[:60]}' cannot be the name of a word. Use letters only, one to {MOST_WORDS} words and at most "
            f"{MOST_LETTERS} letters, for example 'fig' or 'cherry tomato'"
        )
    if names_device(" ".join(folded)):
        raise VocabularyError(
            f"'{text}' is the name of a device on Windows and cannot name a file. Choose another word"
        )
    if not folded:
        raise VocabularyError(f"'{text}' has no meaning of its own in a prompt. Name the fruit, for example 'fig'")
    if described := [word for word in folded if describes(word) or (word in COLOURS and len(folded) > 1)]:
        raise VocabularyError(
            f"'{described[0]}' describes fruit and does not name one. Teach the fruit without it: prompts combine "
            "taught words with colours and ripeness"
        )
    try:
        known = parse(spelled).text
    except VocabularyError:
        return " ".join(folded)
    if known in GENERAL:
        raise VocabularyError(f"'{text}' stands for several objects. Teach one of {', '.join(GENERAL[known])}")
    return known if known in CONCEPTS else " ".join(folded)


def refines(text: str) -> bool:
    """Whether a word of this name would correct a built-in one."""
    try:
        return word_name(text) in CONCEPTS
    except VocabularyError:
        return False


def _is_spelled(text: str) -> bool:
    """Whether a text has letters of any language only, with single characters of _BETWEEN in between."""
    letters = [unicodedata.category(character)[0] in "LM" for character in text]
    apart = [character in _BETWEEN for character in text]
    if not letters or not (letters[0] and letters[-1]):
        return False
    return all(map(max, letters, apart)) and not any(map(min, apart, apart[1:]))
