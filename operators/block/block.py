"""Opens a block of trees as one scene, its trees for review, and writes the reviews into its tables."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from mathutils import Vector

from ...engine.errors import ConfigError, FruitLangsError
from ...engine.progress import part
from ..blender_data import find_owned_object, find_owned_objects, select_only
from ..data.fruit_objects import REVIEW, fruit_frame, metres_per_unit, read_log, write_log
from ..data.read_fruits import read_fruit
from ..data.stored_review import is_reviewed, keep_corrections
from ..data.write import SET_ID
from ..jobs.jobs import JobOperator, Work, describe_error, is_being_edited, is_busy, is_linked, start
from ..settings.settings import format_stored_path, resolve_known_path
from ..viewport.viewport import find_screens, look_at_point, show_colors
from .overview import ShownResult, read_overview
from .write_overview import TREE, color_fruit, write_overview

if TYPE_CHECKING:
    from ...engine.block.reviews import Review
    from ...engine.progress import Progress

TREE_OF, OVERVIEW = "fruitlangs_tree_of_block", "fruitlangs_overview"
"""Custom properties of the Blender scene of a tree: the folder of its result in the block; and of that of a block."""


def block_folder(bpy_scene: bpy.types.Scene) -> Path:
    """The folder of the block that was chosen in this Blender scene.

    Raises:
        ConfigError: none is.
    """
    folder = resolve_known_path(bpy_scene.fruitlangs.block.folder)
    if folder is None:
        raise ConfigError("Choose the folder that count_orchard.py wrote (its --out)")
    return folder


class FRUITLANGS_OT_open_block(JobOperator, bpy.types.Operator):
    bl_idname = "fruitlangs.open_block"
    bl_label = "Open Orchard"
    bl_description = "Show all trees of an orchard that count_orchard.py counted"
    bl_options = {"UNDO"}

    title = "Open Orchard"
    replaces_objects = True

    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return (
            not (is_busy(cls) or is_linked(cls, context) or is_being_edited(cls, context)) and context.scene is not None
        )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not bpy.app.background and not self.directory and not context.scene.fruitlangs.block.folder:
            return self.ask_where(context)
        return super().invoke(context, event)

    def prepare(self, context: bpy.types.Context) -> Work:
        if self.directory:
            context.scene.fruitlangs.block.folder = format_stored_path(Path(bpy.path.abspath(self.directory)))
        folder = block_folder(context.scene)
        return lambda progress: read_block(folder, progress)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        bpy_scene = self._target.scene(context)
        show_block(context, bpy_scene, result)
        trees = bpy_scene.fruitlangs.block.trees
        self.report({"INFO"}, f"{len(trees)} trees, {sum(max(tree.counted, 0) for tree in trees)} fruit counted")
        noted = [tree for tree in trees if tree.note]
        if noted:
            self.report(
                {"WARNING"}, f"Notes on the counts of {len(noted)} trees, first {noted[0].name}: {noted[0].note}"
            )


class FRUITLANGS_OT_open_tree(bpy.types.Operator):
    bl_idname = "fruitlangs.open_tree"
    bl_label = "Open Tree"
    bl_description = "Open the result of the active tree in a Blender scene of its own, to review it"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or context.scene is None:
            return False
        block = context.scene.fruitlangs.block
        if not 0 <= block.active < len(block.trees):
            cls.poll_message_set("Choose a tree in the list")
            return False
        if block.trees[block.active].counted < 0:
            cls.poll_message_set("This tree is not counted")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        overview = context.scene
        tree = overview.fruitlangs.block.trees[overview.fruitlangs.block.active]
        try:
            result = _result_of(overview, tree.folder)
            bpy_scene, is_current = _scene_of(overview, tree.folder, result)
        except FruitLangsError as error:
            self.report({"ERROR"}, describe_error(error))
            return {"CANCELLED"}
        _enter(context, bpy_scene)
        if is_current:
            return {"FINISHED"}
        bpy_scene.fruitlangs.source = format_stored_path(result)
        with context.temp_override(scene=bpy_scene, view_layer=bpy_scene.view_layers[0]):
            answer = start(self, "import_scene")
        if "CANCELLED" in answer:
            _enter(context, overview)
            _remove_if_empty(bpy_scene)
        return answer


class FRUITLANGS_OT_show_block(bpy.types.Operator):
    bl_idname = "fruitlangs.show_block"
    bl_label = "Back to Orchard"
    bl_description = "Show all trees of the block again"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene is not None and context.scene.get(OVERVIEW) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        _enter(context, context.scene[OVERVIEW])
        return {"FINISHED"}


class FRUITLANGS_OT_update_block(JobOperator, bpy.types.Operator):
    bl_idname = "fruitlangs.update_block"
    bl_label = "Update Tables"
    bl_description = "Write the reviews of all opened trees into the tables and the page of the block"
    bl_options = {"UNDO"}

    title = "Update Tables"
    replaces_objects = True

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or context.scene is None or is_being_edited(cls, context):
            return False
        if not context.scene.fruitlangs.block.trees:
            cls.poll_message_set("Press Open Orchard first")
            return False
        return True

    def prepare(self, context: bpy.types.Context) -> Work:
        folder = block_folder(context.scene)
        reviews = {}
        for bpy_scene in bpy.data.scenes:
            own = _tree_of(bpy_scene, context.scene)
            if own is None or SET_ID not in bpy_scene or find_owned_object(bpy_scene, "root") is None:
                continue  # its result was not shown, or was removed
            try:
                keep_corrections(bpy_scene)
            except FruitLangsError as error:
                raise type(error)(f"{bpy_scene.name}: {error}") from error
            if is_reviewed(bpy_scene) or len(bpy_scene.fruitlangs.review.log):  # also if all was undone by Reopen
                reviews[own] = (str(bpy_scene[SET_ID]), read_review_of(bpy_scene))
        return lambda progress: update_block(folder, reviews, progress)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        show_block(context, self._target.scene(context), result.shown)
        self.report({"INFO"}, f"Tables and page updated with the reviews of {result.reviewed} trees")
        if result.outdated:
            self.report(
                {"WARNING"},
                f"The scenes of these trees show another count than the orchard has, so no review was written: "
                f"{', '.join(result.outdated)}. Open them again, then update the tables",
            )


def read_block(folder: Path, progress: Progress) -> list[ShownResult]:
    """What is shown of a block; in the thread of a job."""
    from ...engine.block.ledger import Ledger
    from ...engine.block.trees import read_counts

    ledger = Ledger(folder)
    return read_overview(ledger, read_counts(ledger), progress)


@dataclass(frozen=True, kw_only=True)
class Updated:
    """reviewed: number of reviewed trees; shown: what is shown of the block; outdated: folders of the results of which
    another count is shown, here or by a later count of the orchard; their reviews were not written."""

    reviewed: int
    shown: list[ShownResult]
    outdated: list[str]


def update_block(folder: Path, reviews: dict[str, tuple[str, Review]], progress: Progress) -> Updated:
    """Store reviews, {folder of the result: (its set_id, review)}, and write the tables."""
    from ...engine.block.ledger import Ledger
    from ...engine.block.publish import publish_again
    from ...engine.block.reviews import write_review

    ledger, outdated = Ledger(folder), []
    for own, (set_id, review) in reviews.items():
        result = ledger.folder(own).path
        if read_set_id(result) == set_id:
            write_review(result, set_id, review)
        else:
            outdated.append(own)
    progress(0.1, "writing the tables")
    answer = publish_again(ledger)
    shown = read_overview(ledger, answer.trees, part(progress, 0.2, 1.0))
    return Updated(reviewed=sum(tree.reviewed is not None for tree in answer.trees), shown=shown, outdated=outdated)


def read_set_id(result: Path) -> str:
    """The set_id of the result in a folder, which a new count changes.

    Raises:
        FormatError: it is damaged.
    """
    from ...engine.report.results import FRUITS_JSON, parse_results

    return str(parse_results(result / FRUITS_JSON)["set_id"])


def read_review_of(bpy_scene: bpy.types.Scene) -> Review:
    """The review of the result that this Blender scene shows, rejected fruit included."""
    from ...engine.block.reviews import Review, ReviewedFruit

    no_gaussians = np.zeros(0, np.int32)
    frame, unit = fruit_frame(bpy_scene), metres_per_unit(bpy_scene) or 1.0
    fruits = []
    for item in find_owned_objects(bpy_scene, "fruit"):
        fruit = read_fruit(item, frame, int(item.get("id", 0)), no_gaussians, unit)
        fruits.append(
            ReviewedFruit(
                tree=fruit.tree,
                standing=item.get(REVIEW, ""),
                probability=fruit.probability,
                center=tuple(fruit.center.tolist()),
                axes=tuple(tuple(axis) for axis in (fruit.axes * unit).tolist()),
                diameter=fruit.diameter * unit,
                volume=fruit.volume * unit**3,
                color=tuple(fruit.color.tolist()),
            )
        )
    return Review(fruits=fruits, decisions=read_log(bpy_scene))


def _result_of(overview: bpy.types.Scene, own: str) -> Path:
    """The folder of the result of a tree."""
    from ...engine.block.ledger import Ledger

    return Ledger(block_folder(overview)).folder(own).path


def _scene_of(overview: bpy.types.Scene, own: str, result: Path) -> tuple[bpy.types.Scene, bool]:
    """The Blender scene for the tree with this folder, and whether it already shows the result.

    A scene of an earlier count is used again: its decisions apply to the result when it is shown. But if a review of
    the result is stored, the tree gets a new scene with that review, and the earlier one is left as it is.
    """
    from ...engine.block.reviews import read_review

    set_id = read_set_id(result)
    review = read_review(result, set_id)
    bpy_scene = next((each for each in bpy.data.scenes if _tree_of(each, overview) == own), None)
    if bpy_scene is not None and bpy_scene.get(SET_ID) == set_id:
        return bpy_scene, True
    if bpy_scene is not None and not _remove_if_empty(bpy_scene):
        if review is None:
            return bpy_scene, False
        del bpy_scene[TREE_OF]
    bpy_scene = bpy.data.scenes.new(own)
    bpy_scene[TREE_OF], bpy_scene[OVERVIEW] = own, overview
    for decision in () if review is None else review.decisions:
        write_log(bpy_scene, decision)
    return bpy_scene, False


def _remove_if_empty(bpy_scene: bpy.types.Scene) -> bool:
    """Remove a Blender scene of a tree if nothing is in it; returns whether it was removed."""
    if len(bpy_scene.objects):
        return False
    bpy.data.scenes.remove(bpy_scene)
    return True


def _tree_of(bpy_scene: bpy.types.Scene, overview: bpy.types.Scene) -> str | None:
    """The folder of the tree that a Blender scene shows, if it is one of this overview's."""
    return str(bpy_scene[TREE_OF]) if bpy_scene.get(OVERVIEW) == overview and TREE_OF in bpy_scene else None


def _enter(context: bpy.types.Context, bpy_scene: bpy.types.Scene) -> None:
    if context.window is not None:
        context.window.scene = bpy_scene


def show_block(context: bpy.types.Context, bpy_scene: bpy.types.Scene, results: list[ShownResult]) -> None:
    """Show a block in this Blender scene, and list its trees."""
    block = bpy_scene.fruitlangs.block
    write_overview(bpy_scene, results, block.colors)
    active = block.trees[block.active].name if 0 <= block.active < len(block.trees) else ""
    block.trees.clear()
    for result in results:
        for tree in result.trees:
            entry = block.trees.add()
            entry.name, entry.folder = tree.name, result.folder
            entry.problem, entry.note = tree.problem, tree.note
            entry.counted, entry.reviewed = tree.counted, tree.reviewed
    names = [tree.name for tree in block.trees]
    block["active"] = names.index(active) if active in names else 0
    screens = find_screens(context, bpy_scene)
    show_colors(screens, splats=False)
    corners = [Vector((*result.place, 0.0)) for result in results]
    middle = sum(corners, Vector((0.0, 0.0, 0.0))) / max(len(corners), 1)
    width = max((result.width for result in results), default=0.0)
    reach = width + max(((corner - middle).length for corner in corners), default=0.0)
    look_at_point(screens, middle + Vector((0.0, 0.0, 0.5 * width)), 1.7 * reach)


def select_chosen_tree(block: Any, context: bpy.types.Context) -> None:
    """Called when a tree was chosen in the list: select its fruit."""
    if bpy.context.mode != "OBJECT" or not 0 <= block.active < len(block.trees):
        return
    name = block.trees[block.active].name
    select_only(context, [item for item in find_owned_objects(context.scene, "block-fruit") if item.get(TREE) == name])


def apply_block_colors(block: Any, context: bpy.types.Context) -> None:
    """Called when the colours of the fruit were chosen."""
    color_fruit(block.id_data, block.colors)


CLASSES = (
    FRUITLANGS_OT_open_block,
    FRUITLANGS_OT_open_tree,
    FRUITLANGS_OT_show_block,
    FRUITLANGS_OT_update_block,
)
