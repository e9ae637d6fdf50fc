"""Review: the user confirms, rejects, merges, splits, adds and relabels fruit, with undo and a log."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ...engine.errors import CountingError, FruitLangsError
from ..blender_data import OWNER, find_owned_object, find_owned_objects, remove_objects, select_only
from ..data.fruit_objects import (
    CONFIRMED,
    REJECTED,
    REVIEW,
    check_made,
    choose_new_ids,
    find_usual_diameter,
    format_now,
    fruit_collection,
    fruit_frame,
    give_members,
    judge,
    make_fruit,
    members,
    metres_per_unit,
    spot_of,
    write_log,
)
from ..data.manual_edits import remember_fruit
from ..data.stored_review import keep_corrections
from ..data.write_fruits import SHOWN, label_fruit
from ..jobs.jobs import describe_error, is_busy, is_editing
from ..scene_frame import scene_frame
from ..tools.pick_tool import PickTool
from ..viewport.viewport import find_screens, look_at_point

if TYPE_CHECKING:
    from ...engine.counting.accounts.review import Action, Spot

CLOSE = 8.0
"""Distance in diameters from which a fruit is shown."""
NO_SIZE = "The size of the new fruit is unknown. Enter its diameter below Add first"


def list_selected_fruit(context: bpy.types.Context) -> list[bpy.types.Object]:
    """List the selected fruit, the active one first."""
    own = [item for item in context.selected_objects if item.get(OWNER) == "fruit"]
    active = context.view_layer.objects.active
    return sorted(own, key=lambda item: (item != active, item.get("id", 0)))


def has_root(operator: Any, context: bpy.types.Context) -> bool:
    """Whether the scene's root exists; the operator's poll shows a missing one as the reason."""
    if find_owned_object(context.scene, "root") is not None:
        return True
    operator.poll_message_set("The scene's root empty was deleted. Undo that, or import or count again")
    return False


class Judgement:
    """Mix-in of operators that change the selected fruit."""

    needs: ClassVar[int] = 1
    """Least number of selected fruit."""

    reason: bpy.props.StringProperty(
        name="Reason", options={"SKIP_SAVE"}, description="Reason kept in the log; empty uses the reason of the panel"
    )

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_editing(cls, context) or not has_root(cls, context):
            return False
        if len(list_selected_fruit(context)) < cls.needs:
            many = "a fruit" if cls.needs == 1 else f"{cls.needs} fruit or more (Shift and click)"
            cls.poll_message_set(f"Select {many} in the list or in the viewport")
            return False
        return True

    def execute(self: Any, context: bpy.types.Context) -> set[str]:
        try:
            for line in keep_corrections(context.scene):
                self.report({"INFO"}, line)
            self.decide(context)
            remember_fruit(context.scene)
        except Exception as error:
            self.report({"ERROR"}, describe_error(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def decide(self, context: bpy.types.Context) -> None:
        """Do it; every error is reported, so it must occur before anything changes.

        Raises:
            FruitLangsError: it cannot be done.
        """
        raise NotImplementedError

    def log(
        self: Any, context: bpy.types.Context, action: Action, before: Sequence[Spot] = (), after: Sequence[Spot] = ()
    ) -> None:
        """Log the decision with the reason in the panel, which is then cleared."""
        from ...engine.counting.accounts.review import Decision

        review = context.scene.fruitlangs.review
        reason, review.reason = self.reason or review.reason, ""
        write_log(context.scene, Decision(action, format_now(), reason.strip(), tuple(before), tuple(after)))


def _spots(context: bpy.types.Context, items: Sequence[bpy.types.Object]) -> list[Spot]:
    frame = fruit_frame(context.scene)
    return [spot_of(item, frame) for item in items]


class FRUITLANGS_OT_confirm_fruit(Judgement, bpy.types.Operator):
    bl_idname = "fruitlangs.confirm_fruit"
    bl_label = "Confirm"
    bl_description = "Mark the selected fruit as correct"
    bl_options = {"REGISTER", "UNDO"}

    def decide(self, context: bpy.types.Context) -> None:
        items = list_selected_fruit(context)
        self.log(context, "confirm", _spots(context, items))
        for item in items:
            judge(item, CONFIRMED)


class FRUITLANGS_OT_reject_fruit(Judgement, bpy.types.Operator):
    bl_idname = "fruitlangs.reject_fruit"
    bl_label = "Reject"
    bl_description = "Mark the selected fruit as wrong; they are hidden and not counted"
    bl_options = {"REGISTER", "UNDO"}

    def decide(self, context: bpy.types.Context) -> None:
        items = list_selected_fruit(context)
        self.log(context, "reject", _spots(context, items))
        for item in items:
            judge(item, REJECTED)


class FRUITLANGS_OT_reopen_fruit(Judgement, bpy.types.Operator):
    bl_idname = "fruitlangs.reopen_fruit"
    bl_label = "Reopen"
    bl_description = "Undo the decision on the active fruit of the list; a rejected fruit is shown and counted again"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or not has_root(cls, context):
            return False
        item = context.view_layer.objects.active
        if item is None or item.get(OWNER) != "fruit" or item.get(REVIEW) not in (CONFIRMED, REJECTED):
            cls.poll_message_set("Choose a confirmed or rejected fruit in the list")
            return False
        return True

    def decide(self, context: bpy.types.Context) -> None:
        item = context.view_layer.objects.active
        self.log(context, "reopen", _spots(context, [item]))
        judge(item, "")
        select_only(context, [item])


class FRUITLANGS_OT_merge_fruit(Judgement, bpy.types.Operator):
    bl_idname = "fruitlangs.merge_fruit"
    bl_label = "Merge"
    bl_description = "Merge the selected fruit into one"
    bl_options = {"REGISTER", "UNDO"}

    needs = 2

    def decide(self, context: bpy.types.Context) -> None:
        from ...engine.counting.accounts.review import merge

        items = list_selected_fruit(context)
        before = _spots(context, items)
        whole = merge(before, choose_new_ids(context.scene, 1)[0], find_usual_diameter(context.scene))
        own = np.concatenate([members(context.scene, item)[0] for item in items])
        give_members(context.scene, own, whole.id)
        made = make_fruit(context.scene, whole, items[0])
        self.log(context, "merge", before, [whole])
        remove_objects(items)
        select_only(context, [made])


class FRUITLANGS_OT_split_fruit(Judgement, bpy.types.Operator):
    bl_idname = "fruitlangs.split_fruit"
    bl_label = "Split"
    bl_description = "Split the active fruit into several, following its Gaussians"
    bl_options = {"REGISTER", "UNDO"}

    parts: bpy.props.IntProperty(name="Parts", default=2, min=2, max=12, description="Number of fruit to make")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.parts = context.scene.fruitlangs.review.parts
        return self.execute(context)

    def decide(self, context: bpy.types.Context) -> None:
        from ...engine.counting.accounts.review import split

        item = list_selected_fruit(context)[0]
        before = _spots(context, [item])[0]
        own, places = members(context.scene, item)
        usual = find_usual_diameter(context.scene)
        spots, owners = split(before, self.parts, places, choose_new_ids(context.scene, self.parts), usual=usual)
        made = [make_fruit(context.scene, spot, item) for spot in spots]
        give_members(context.scene, own, np.array([spot.id for spot in spots])[owners] if len(own) else 0)
        self.log(context, "split", [before], spots)
        remove_objects([item])
        select_only(context, made)


class FRUITLANGS_OT_relabel_fruit(Judgement, bpy.types.Operator):
    bl_idname = "fruitlangs.relabel_fruit"
    bl_label = "Move to Label"
    bl_description = "Change the label of the selected fruit, for example to ripe apple"
    bl_options = {"REGISTER", "UNDO"}

    label: bpy.props.StringProperty(
        name="Label", options={"SKIP_SAVE"}, description="New label; empty uses the label of the panel"
    )

    def decide(self, context: bpy.types.Context) -> None:
        label = " ".join((self.label or context.scene.fruitlangs.review.label).split())
        if not label:
            raise CountingError("Type the label first")
        self.reason = self.reason or context.scene.fruitlangs.review.reason
        for item in list_selected_fruit(context):
            before = _spots(context, [item])
            label_fruit(item, label, context.scene)
            judge(item, CONFIRMED)
            self.log(context, "relabel", before, _spots(context, [item]))


class FRUITLANGS_OT_add_fruit(PickTool, Judgement, bpy.types.Operator):
    bl_idname = "fruitlangs.add_fruit"
    bl_label = "Add"
    bl_description = "Add a fruit that was missed by clicking on it"
    bl_options = {"REGISTER", "UNDO"}

    asks = ("click on a fruit that was missed",)

    center: bpy.props.FloatVectorProperty(
        name="Centre", size=3, precision=4, options={"SKIP_SAVE"}, description="Position x y z in the scene frame"
    )
    diameter: bpy.props.FloatProperty(
        name="Diameter",
        min=0.0,
        precision=4,
        options={"SKIP_SAVE"},
        description="Diameter in scene units; 0 uses the mean of the others",
    )

    def invoke(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not choose_new_diameter(context.scene) > 0.0:
            self.report({"ERROR"}, NO_SIZE)
            return {"CANCELLED"}
        return super().invoke(context, event)

    def handle_points(self, context: bpy.types.Context, points: NDArray[np.float64]) -> set[str]:
        # The click is on the surface: the centre lies half a diameter behind it, away from the viewer.
        direction = self._target3d.direction
        self.center = (points[0] + 0.5 * choose_new_diameter(context.scene) * direction).tolist()
        return self.execute(context)

    def decide(self, context: bpy.types.Context) -> None:
        from ...engine.counting.accounts.review import ball

        label = context.scene.fruitlangs.result.label or context.scene.fruitlangs.prompt
        size = self.diameter or choose_new_diameter(context.scene)
        if not size > 0.0:
            raise CountingError(NO_SIZE)
        check_made(context.scene, "The new fruit", np.array(self.center), size)
        spot = ball(choose_new_ids(context.scene, 1)[0], label, np.array(self.center), size)
        made = make_fruit(context.scene, spot, None)
        self.log(context, "add", after=[spot])
        select_only(context, [made])


def choose_new_diameter(bpy_scene: bpy.types.Scene) -> float:
    """Choose the diameter of an added fruit, scene units: the median diameter, else the one entered in the panel; 0
    without either.

    The panel has a field for each unit, so that a later scale does not change the meaning of a number.
    """
    review, metres = bpy_scene.fruitlangs.review, metres_per_unit(bpy_scene)
    typed = review.diameter if metres is None else review.diameter_mm / (1000.0 * metres)
    return find_usual_diameter(bpy_scene) or float(typed)


class FRUITLANGS_OT_next_uncertain(bpy.types.Operator):
    bl_idname = "fruitlangs.next_uncertain"
    bl_label = "Next Uncertain"
    bl_description = "Show the fruit that are not reviewed yet one by one, from the lowest probability upwards"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_editing(cls, context):
            return False
        if not list_uncertain(context.scene):
            cls.poll_message_set("Every fruit is reviewed")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        ranked = list_uncertain(context.scene)
        left = [item for item in ranked if SHOWN not in item]
        if not left:
            for item in ranked:
                del item[SHOWN]
            self.report({"INFO"}, "Every fruit that is not reviewed was shown. This is the first one again")
        item = (left or ranked)[0]
        item[SHOWN] = True
        select_only(context, [item])
        if context.view_layer.objects.active != item:
            self.report(
                {"WARNING"},
                f"{item.name} is in no collection of this view layer. Enable its collection in the Outliner",
            )
            return {"CANCELLED"}
        if find_owned_object(context.scene, "root") is not None:
            try:
                _look_at_fruit(context, item)
            except FruitLangsError as error:
                self.report({"WARNING"}, str(error))
                return {"FINISHED"}
        self.report({"INFO"}, f"{item.name}: probability {item.get('probability', 1.0):.2f}")
        return {"FINISHED"}


def _look_at_fruit(context: bpy.types.Context, item: bpy.types.Object) -> None:
    frame = scene_frame(context.scene)
    spot = spot_of(item, frame)
    place = frame.to_world @ Vector(spot.center)
    look_at_point(find_screens(context, context.scene), place, CLOSE * spot.diameter * frame.world_scale)


def list_uncertain(bpy_scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """List the fruit that are not reviewed, the lowest probability first."""
    open_ones = [item for item in find_owned_objects(bpy_scene, "fruit") if REVIEW not in item]
    return sorted(open_ones, key=lambda item: (item.get("probability", 1.0), item.get("id", 0)))


def get_active_fruit(review: Any) -> int:
    """Index of the active object among the fruit; -1 if another one is active."""
    collection = fruit_collection(review.id_data)
    active = bpy.context.view_layer.objects.active if bpy.context.view_layer else None
    return -1 if collection is None or active is None else collection.objects.find(active.name)


def set_active_fruit(review: Any, index: int) -> None:
    """Select only the fruit with that index."""
    collection = fruit_collection(review.id_data)
    if collection is None or bpy.context.mode != "OBJECT" or not 0 <= index < len(collection.objects):
        return
    select_only(bpy.context, [collection.objects[index]])


CLASSES = (
    FRUITLANGS_OT_confirm_fruit,
    FRUITLANGS_OT_reject_fruit,
    FRUITLANGS_OT_reopen_fruit,
    FRUITLANGS_OT_merge_fruit,
    FRUITLANGS_OT_split_fruit,
    FRUITLANGS_OT_relabel_fruit,
    FRUITLANGS_OT_add_fruit,
    FRUITLANGS_OT_next_uncertain,
)
