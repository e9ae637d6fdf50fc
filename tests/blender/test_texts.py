"""Labels and tooltips follow Blender's conventions."""

from __future__ import annotations

import re

import bpy
import pytest

from fruitlangs.fruitlangs_addon.registration import CLASSES

SMALL_WORDS = {"a", "as", "at", "by", "from", "in", "of", "on", "or", "the", "to", "with", "mm", "m", "glTF"}
OPERATORS = [each for each in CLASSES if issubclass(each, bpy.types.Operator)]
PANELS = [each for each in CLASSES if issubclass(each, bpy.types.Panel)]
GROUPS = [each for each in CLASSES if issubclass(each, bpy.types.PropertyGroup)]


def is_title_case(label: str) -> bool:
    return all(
        word[0].isupper() or word[0].isdigit() or word in SMALL_WORDS | {"glTF"}
        for word in re.findall(r"[\w.-]+", label)
    )


def own_properties(item: type) -> list[bpy.types.Property]:
    own = getattr(item, "__annotations__", {})
    return [each for each in item.bl_rna.properties if each.identifier in own]


def name(item: type) -> str:
    return item.__name__


@pytest.mark.parametrize("item", [*OPERATORS, *PANELS], ids=name)
def test_labels_have_at_most_three_words_in_title_case(extension, item):
    label = re.sub(r"^\d ", "", item.bl_label)  # the number of a step
    assert len(label.split()) <= 3
    assert is_title_case(label), label


@pytest.mark.parametrize("item", OPERATORS, ids=name)
def test_every_operator_has_a_tooltip_of_one_sentence_without_a_full_stop(extension, item):
    assert item.bl_description[:1].isupper()
    assert not item.bl_description.endswith(".")
    assert ". " not in item.bl_description


@pytest.mark.parametrize("item", [*OPERATORS, *GROUPS], ids=name)
def test_every_property_has_a_label_in_title_case_and_a_tooltip(extension, item):
    for each in own_properties(item):
        if each.type in ("POINTER", "COLLECTION"):
            continue
        assert is_title_case(each.name), f"{each.identifier}: {each.name}"
        assert len(each.name.split()) <= 3, f"{each.identifier}: {each.name}"
        assert each.description[:1].isupper() or each.description[:1] in "0123456789.", f"{each.identifier}"
        assert not each.description.endswith("."), each.identifier
