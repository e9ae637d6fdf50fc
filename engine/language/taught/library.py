"""The taught words of a folder, by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ...errors import EncoderError, FormatError, VocabularyError
from .name import word_name
from .word import SUFFIX, TaughtWord, read_word


@dataclass(frozen=True, eq=False)
class Library(Mapping[str, TaughtWord]):
    """Words by name. A file that cannot be read is an error when its word is asked for, and only then.

    files: of each word; encoder_id: identity of the encoder that is asked with them.
    """

    files: Mapping[str, Path] = field(default_factory=dict)
    encoder_id: str = ""
    _read: dict[str, TaughtWord] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, encoder_id: str) -> Library:
        """The words of all files in a folder, which need not exist. The name of a file is the name of its word."""
        found = sorted(folder.glob(f"*{SUFFIX}")) if folder.is_dir() else []
        return cls({name_of(file.name): file for file in found if is_word_file(file.name)}, encoder_id)

    def __getitem__(self, name: str) -> TaughtWord:
        """The word.

        Raises:
            FormatError: its file is damaged, or of another word.
            EncoderError: it was learnt with another encoder.
        """
        file = self.files[name]
        if name not in self._read:
            word = read_word(file)
            if word.name != name:
                raise FormatError(f"{file} holds the word '{word.name}'. Give the file the name of its word")
            if word.encoder_id != self.encoder_id:
                raise EncoderError(
                    f"The word '{name}' ({file}) was taught with the encoder {word.encoder_id}, not with "
                    f"{self.encoder_id}. Teach it again, or choose that encoder"
                )
            self._read[name] = word
        return self._read[name]

    def __contains__(self, name: object) -> bool:
        return name in self.files

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)


def name_of(file: str) -> str:
    """The name of the word in a file, by the name of the file."""
    return file.removesuffix(SUFFIX).replace("-", " ")


def is_word_file(file: str) -> bool:
    """Whether the name of a file is that of a word; others, such as those of an interrupted copy, are none."""
    try:
        return word_name(name_of(file)) == name_of(file)
    except VocabularyError:
        return False


def word_file(folder: Path, name: str) -> Path:
    """The file of a word in a folder of words."""
    return folder / f"{name.replace(' ', '-')}{SUFFIX}"
