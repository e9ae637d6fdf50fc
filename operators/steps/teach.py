"""Teaching a word by clicks: the highlight follows each click, and Save Word makes it available to every prompt."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ...engine.errors import FruitLangsError
from ..blender_data import find_owned_object
from ..data.fruit_objects import (
    ADDED,
    CONFIRMED,
    REJECTED,
    REVIEW,
    fruit_collection,
    fruit_frame,
    is_made,
    members,
    spot_of,
)
from ..jobs.jobs import describe_error, is_busy, is_linked
from ..scene_frame import scene_frame
from ..settings.lesson import read_lesson
from ..settings.settings import read_config
from ..tools.pick_tool import PickTool
from ..viewport.viewport import find_screens, has_window, look_at_point
from .ask import ask_soon, has_gaussians, learn_word, means_of, question_of

DISTANCE = 0.4
"""Distance from which an example is shown, in standard deviations of the Gaussians' positions."""


def begin(settings: Any) -> None:
    """Make the prompt that of the taught word, and show what it matches now."""
    if settings.prompt.strip() != settings.teach.word.strip():
        settings.prompt = settings.teach.word.strip()
    show_soon(settings)


def show_soon(settings: Any, _context: Any = None) -> None:
    """Called when the word or an example changed: the highlight follows, in a window."""
    if settings.id_data.library is None and has_window():
        ask_soon(settings.id_data)


def add_example(settings: Any, place: NDArray[np.float64], *, positive: bool, source: str) -> None:
    """Add an example at a place (3,) of the scene frame, and show what the word matches now."""
    teach = settings.teach
    example = teach.examples.add()
    example.place, example.positive, example.source = place.tolist(), positive, source
    teach.active = len(teach.examples) - 1
    begin(settings)


class Teaching:
    """Mix-in of operators that need Gaussians with features, and a name for the word."""

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context) or not has_gaussians(cls, context):
            return False
        if not context.scene.fruitlangs.teach.word.strip():
            cls.poll_message_set("Enter the name of the word first")
            return False
        return True


class FRUITLANGS_OT_add_examples(Teaching, PickTool, bpy.types.Operator):
    bl_idname = "fruitlangs.add_examples"
    bl_label = "Add Examples"
    bl_description = "Click on fruit that the word names; with Shift, click on what it does not name"
    bl_options = {"REGISTER", "UNDO"}

    asks = ("click on fruit that the word names, Shift and click on what it does not name",)
    endless = True

    def invoke(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        from ...engine.language.taught.name import word_name

        try:
            word_name(context.scene.fruitlangs.teach.word)
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return super().invoke(context, event)

    def handle_click(self: Any, context: bpy.types.Context, point: NDArray[np.float64], event: bpy.types.Event) -> None:
        add_example(context.scene.fruitlangs, point, positive=not event.shift, source="click")

    def take_back_click(self: Any, context: bpy.types.Context) -> None:
        remove_example(context.scene.fruitlangs, len(context.scene.fruitlangs.teach.examples) - 1)


class FRUITLANGS_OT_add_reviewed(Teaching, bpy.types.Operator):
    bl_idname = "fruitlangs.add_reviewed"
    bl_label = "Add Reviewed"
    bl_description = "Add the fruit that were confirmed, added or rejected in the review as examples"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if not list_reviewed(context.scene):
            cls.poll_message_set("No fruit is reviewed yet. Confirm or reject some in step 5")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.fruitlangs
        known = {example.source for example in settings.teach.examples}
        try:
            frame = fruit_frame(context.scene)
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        alone = []
        for item in list_reviewed(context.scene):
            source = f"fruit {item.get('id', 0)}"
            if source in known:
                continue
            if not is_made(item) and not len(members(context.scene, item)[0]):
                alone.append(source)
                continue
            positive = item.get(REVIEW) != REJECTED
            add_example(settings, spot_of(item, frame).center, positive=positive, source=source)
        if alone:
            reason = "found in the photos alone, so there are no Gaussians to learn from"
            self.report({"WARNING"}, f"Not added: {', '.join(alone)}, {reason}")
        return {"FINISHED"}


def list_reviewed(bpy_scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """List the fruit that the user has decided on."""
    collection = fruit_collection(bpy_scene)
    items = [] if collection is None else list(collection.objects)
    return [item for item in items if item.get(REVIEW) in (CONFIRMED, ADDED, REJECTED)]


class Listed:
    """Mix-in of operators on the active example of the list."""

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context) or context.scene is None:
            return False
        teach = context.scene.fruitlangs.teach
        if not 0 <= teach.active < len(teach.examples):
            cls.poll_message_set("Select an example in the list")
            return False
        return True


class FRUITLANGS_OT_remove_example(Listed, bpy.types.Operator):
    bl_idname = "fruitlangs.remove_example"
    bl_label = "Remove Example"
    bl_description = "Remove the selected example; the word is learnt again without it"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        remove_example(context.scene.fruitlangs, context.scene.fruitlangs.teach.active)
        return {"FINISHED"}


def remove_example(settings: Any, index: int) -> None:
    """Remove an example, and show what the word matches without it."""
    settings.teach.examples.remove(index)
    settings.teach.active = min(index, len(settings.teach.examples) - 1)
    show_soon(settings)


class FRUITLANGS_OT_look_at_example(Listed, bpy.types.Operator):
    bl_idname = "fruitlangs.look_at_example"
    bl_label = "Show Example"
    bl_description = "Move the viewport to the selected example"

    def execute(self, context: bpy.types.Context) -> set[str]:
        teach = context.scene.fruitlangs.teach
        try:
            frame = scene_frame(context.scene)
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        place = frame.to_world @ Vector(teach.examples[teach.active].place)
        spread = (
            float(means_of(context.scene).std(axis=0).mean()) if find_owned_object(context.scene, "gaussians") else 1.0
        )
        distance = frame.world_scale * DISTANCE * spread
        look_at_point(find_screens(context, context.scene), place, distance)
        return {"FINISHED"}


class FRUITLANGS_OT_save_word(Teaching, bpy.types.Operator):
    bl_idname = "fruitlangs.save_word"
    bl_label = "Save Word"
    bl_description = "Save the word in your folder of words, so that every prompt and every count understands it"

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if read_lesson(context.scene.fruitlangs) is None:
            cls.poll_message_set("Add an example that shows the word first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        from ...engine.language.encoders.open_encoder import folder_of_words
        from ...engine.language.taught.library import word_file
        from ...engine.language.taught.word import save_word

        settings = context.scene.fruitlangs
        try:
            word = learn_word(question_of(context.scene), means_of(context.scene))
            file = word_file(folder_of_words(read_config(settings).embed), word.name)
            file.parent.mkdir(parents=True, exist_ok=True)
            save_word(file, word)
        except Exception as error:
            self.report({"ERROR"}, describe_error(error))
            return {"CANCELLED"}
        settings.teach.saved = f"{word.name}: saved as {file}"
        self.report({"INFO"}, f"The word '{word.name}' is saved as {file}")
        return {"FINISHED"}


CLASSES = (
    FRUITLANGS_OT_add_examples,
    FRUITLANGS_OT_add_reviewed,
    FRUITLANGS_OT_remove_example,
    FRUITLANGS_OT_look_at_example,
    FRUITLANGS_OT_save_word,
)
