"""A day of work in the window, from import to export, by clicks and keys; a picture after every step."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

from guide.film import Film
from guide.hand import LEFT, MOMENT, Hand, Steps

FRONT = 0.03
"""Scene units between a Gaussian and the surface under its position in the window, if it is in front."""
EDGE = 0.815
"""Position across the sidebar of the small buttons next to a list, as a share of its width."""
TAUGHT = "quince"
"""The word that is taught: no built-in one."""
COPIES = 7
"""Trees of the block that are counted."""
WAIT = 0.3
"""Seconds between two checks whether a job has ended."""


@dataclass(frozen=True, kw_only=True)
class Day:
    """The inputs of the day. pictures: their folder, None for none; check: called with a fact after each step."""

    scene: Path
    work: Path
    prompt: str
    other: str
    steps: int | None
    downscale: float | None
    threshold: float | None
    pictures: Path | None
    check: Callable[[str, bool], None]


def live(hand: Hand, day: Day, film: Film | None = None) -> Steps:
    """Run the whole day, and film it."""
    for do, what in PARTS.items():
        steps = do(hand, day)
        if film is not None:
            film.caption = what
            steps = film.record(steps, lambda: find_running_job() is not None)
        yield from steps


def settings() -> Any:
    """`scene.fruitlangs`; read each time, because undo invalidates old references."""
    return bpy.context.window_manager.windows[0].scene.fruitlangs


def find_owned(role: str) -> list[bpy.types.Object]:
    scene = bpy.context.window_manager.windows[0].scene
    return [item for item in scene.objects if item.get("fruitlangs") == role]


def import_scene(hand: Hand, day: Day) -> Steps:
    """Choose the folder and press Import."""
    bpy.ops.wm.save_as_mainfile(filepath=str(day.work / "orchard.blend"))
    settings().source = f"//{day.scene.name}"  # as the file browser stores it
    if day.steps:
        settings().config.train.steps = day.steps
    if day.downscale:
        settings().config.scene.downscale = day.downscale
    if day.threshold:
        settings().config.count.threshold = day.threshold
    bpy.ops.ed.undo_push(message="Choose the scene")
    yield 0.5
    yield from hand.scroll_to_top()
    yield from hand.push("fruitlangs.import_scene")
    yield from wait_for_work(hand)
    day.check("the cameras are shown", len(find_owned("camera")) > 0)
    yield from take_picture(hand, day, "scene")


def measure(hand: Hand, day: Day) -> Steps:
    """Click on the two ends of a length and type it."""
    yield from hand.scroll_to_top()
    yield from hand.push("fruitlangs.measure")
    day.check("no scale yet", not find_owned("root")[0].get("metres_per_unit"))
    for end in find_ends(hand):
        yield from hand.click(*end)
        yield 0.5
    yield from take_picture(hand, day, "measure", rest=False)
    yield from hand.press("RET", *hand.mouse)
    yield 0.5
    day.check("the scale is known", bool(find_owned("root")[0].get("metres_per_unit")))
    yield from hand.press("Z", *hand.aside, ctrl=True)
    yield 0.5
    day.check("undo takes the scale back", not find_owned("root")[0].get("metres_per_unit"))


def find_ends(hand: Hand) -> list[tuple[float, float]]:
    """Find positions of two sparse points near the middle of the view, far apart."""
    points = find_owned("points")[0]
    places = [hand.place_of(points.matrix_world @ vertex.co) for vertex in list(points.data.vertices)[:4000:7]]
    window = hand.region("WINDOW")
    inside = [
        place
        for place in places
        if 0.2 < (place[0] - window.x) / window.width < 0.6 and 0.2 < (place[1] - window.y) / window.height < 0.7
    ]
    return [min(inside), max(inside)]


def reconstruct(hand: Hand, day: Day) -> Steps:
    """Train while the splats are shown; Esc once, then continue; a picture on the way."""
    yield from start_training(hand, until=0.2)
    yield from hand.press("ESC", *hand.aside)
    yield from wait_for_work(hand)
    day.check("Esc ends the job and nothing is shown", not find_owned("gaussians") and not settings().error)
    yield from start_training(hand, until=0.45)
    yield from take_picture(hand, day, "reconstruct")
    yield from wait_for_work(hand)
    day.check("the Gaussians are shown", len(find_owned("gaussians")) == 1)
    day.check("no error", not settings().error)


def start_training(hand: Hand, *, until: float) -> Steps:
    """Press Reconstruct and wait until this share of the job is done."""
    yield from hand.scroll_to_top()
    yield from hand.push("fruitlangs.reconstruct")
    yield from hand.rest()
    job = find_running_job()
    while job is not None and job.fraction < until and find_running_job() is not None:
        yield WAIT


def ask(hand: Hand, day: Day) -> Steps:
    """Edit the prompt; the highlight follows."""
    for words in (day.other, day.prompt):
        yield from hand.scroll_to_top()
        x, y = yield from hand.find("fruitlangs.prompt")
        yield from hand.click(x, y)
        yield from hand.write(words, x, y)
        yield from hand.rest()
        waited = 0.0
        while read_question() != f"{words} | " and waited < 20.0:
            yield 0.1
            waited += 0.1
        day.check(f"the Gaussians match {words}", read_question() == f"{words} | ")
    yield from take_picture(hand, day, "ask")


def teach(hand: Hand, day: Day) -> Steps:
    """Teach a word by two clicks on fruit and one on something else; the highlight follows; then take it back."""
    yield from hand.scroll_to_top()
    x, y = yield from hand.find("fruitlangs.teach.word")
    yield from hand.click(x, y)
    yield from hand.write(TAUGHT, x, y)
    yield from hand.scroll_to_top()
    yield from hand.push("fruitlangs.add_examples", LEFT)
    bright, dark = find_matching_places(hand)
    for place in bright:
        yield from hand.click(*place)
        yield 2.0
    yield from hand.click(*dark, shift=True)
    yield 2.0
    yield from hand.press("RET", *hand.aside)
    yield 1.0
    examples = [example.positive for example in settings().teach.examples]
    day.check("two examples show the word and one does not", examples == [True, True, False])
    day.check("the highlight is that of the word", read_question().startswith(f"{TAUGHT} |  | {TAUGHT} "))
    yield from hand.find("fruitlangs.save_word")
    yield from take_picture(hand, day, "teach")
    yield from hand.push("fruitlangs.remove_example", EDGE)
    yield 2.0
    day.check("an example is removed", len(settings().teach.examples) == 2)
    settings().teach.examples.clear()
    settings().teach.word = ""
    settings().prompt = day.prompt
    bpy.ops.ed.undo_push(message="Ask for the fruit again")
    yield 2.0


def find_matching_places(hand: Hand) -> tuple[list[tuple[float, float]], tuple[float, float]]:
    """Find positions of two Gaussians in front that match the prompt best, far apart in the middle of the view, and of
    one that does not match it."""
    from fruitlangs.operators.tools.pick_tool import Target3D

    item, window = find_owned("gaussians")[0], hand.region("WINDOW")
    said = [entry.value for entry in item.data.attributes["probability"].data]
    order = sorted(range(len(said)), key=lambda index: -said[index])
    target, view = Target3D(bpy.context.window_manager.windows[0].scene), hand.area.spaces.active.region_3d

    def select_in_front(indices: list[int]) -> list[tuple[float, float]]:
        found = []
        for vertex in (item.data.vertices[index] for index in indices):
            x, y = hand.place_of(item.matrix_world @ vertex.co)
            if not (0.25 < (x - window.x) / window.width < 0.6 and 0.3 < (y - window.y) / window.height < 0.7):
                continue
            hit = target.find_hit(window, view, (x - window.x, y - window.y))
            if hit is not None and (Vector(hit) - vertex.co).length < FRONT:
                found.append((x, y))
        return found

    bright, dark = select_in_front(order[:800]), select_in_front(order[-2000:-1000])
    return [min(bright), max(bright)], dark[0]


def read_question() -> str:
    return str(find_owned("gaussians")[0].data.get("fruitlangs_asked", ""))


def count(hand: Hand, day: Day) -> Steps:
    """Press Count."""
    yield from hand.scroll_to_top()
    yield from hand.push("fruitlangs.count")
    yield from hand.rest()
    yield from wait_for_work(hand)
    day.check("fruit are counted", settings().result.count == len(find_owned("fruit")) > 0)
    yield from take_picture(hand, day, "count")


def review(hand: Hand, day: Day) -> Steps:
    """Go to the uncertain fruit, view it in a photo, reject it, undo that, do it again; then use the other tools."""
    before = settings().result.count
    view = hand.area.spaces.active.region_3d
    tree = view.view_location.copy(), view.view_distance
    settings().review.labels = "NUMBER"
    yield from hand.push("fruitlangs.next_uncertain")
    view.view_distance *= 2.5
    yield from take_picture(hand, day, "review")
    settings().review.labels = "NONE"
    yield from hand.push("fruitlangs.best_photo")
    yield from hand.rest()
    day.check("the viewport looks through a photo's camera", view_of(hand) == "CAMERA")
    yield from take_picture(hand, day, "photo")
    yield from hand.push("fruitlangs.free_view")
    day.check("the view is free again", view_of(hand) != "CAMERA")
    yield from hand.scroll_to_top()
    yield from hand.push("fruitlangs.reject_fruit")
    day.check("the fruit is rejected", count_standing() == before - 1)
    yield from hand.press("Z", *hand.aside, ctrl=True)
    yield 0.5
    day.check("undo brings it back", count_standing() == before)
    yield from hand.press("Z", *hand.aside, ctrl=True, shift=True)
    yield 0.5
    day.check("redo rejects it again", count_standing() == before - 1)
    day.check("the log has it", len(settings().review.log) == 1)
    yield from use_other_tools(hand, day)
    view = hand.area.spaces.active.region_3d
    view.view_location, view.view_distance = tree


def use_other_tools(hand: Hand, day: Day) -> Steps:
    """Confirm a fruit, split it, merge the parts again, and add one by a click on the tree."""
    before = count_standing()
    yield from hand.push("fruitlangs.next_uncertain")
    yield from hand.push("fruitlangs.confirm_fruit", LEFT)
    day.check("the fruit is confirmed", settings().review.log[-1].action == "confirm")
    yield from hand.push("fruitlangs.split_fruit", LEFT)
    day.check("it is split in two, which are selected", count_standing() == before + 1)
    yield from hand.push("fruitlangs.merge_fruit", LEFT)
    day.check("they are one again", count_standing() == before)
    yield from hand.push("fruitlangs.add_fruit")
    yield from hand.click(*find_nearest_fruit(hand))
    yield 0.5
    day.check("a click on the tree adds a fruit", count_standing() == before + 1)
    yield from hand.press("Z", *hand.aside, ctrl=True)
    yield 0.5
    day.check("undo takes it away", count_standing() == before)


def find_nearest_fruit(hand: Hand) -> tuple[float, float]:
    """Find the position of the fruit nearest to the middle of the view."""
    window = hand.region("WINDOW")
    middle = window.x + 0.4 * window.width, window.y + 0.5 * window.height
    places = [hand.place_of(item.matrix_world.translation) for item in find_owned("fruit")]
    return min(places, key=partial(math.dist, middle))


def view_of(hand: Hand) -> str:
    return str(hand.area.spaces.active.region_3d.view_perspective)


def count_standing() -> int:
    return sum(item.get("review") != "rejected" for item in find_owned("fruit"))


def export(hand: Hand, day: Day) -> Steps:
    """Write a table of the reviewed fruit with its file dialog."""
    yield from hand.find("fruitlangs.export_ply")  # the last one: all are visible
    yield from take_picture(hand, day, "export")
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"  # in this window, where the pointer is
    yield from hand.push("fruitlangs.export_csv")
    yield 1.0
    browser = next(area for area in hand.window.screen.areas if area.type == "FILE_BROWSER")
    chosen = browser.spaces.active.params
    chosen.directory, chosen.filename = str(day.work).encode(), "fruit.csv"
    yield 0.5
    yield from hand.press("RET", browser.x + browser.width / 2, browser.y + browser.height / 2)
    yield from wait_for_work(hand)
    rows = (day.work / "fruit.csv").read_text(encoding="utf-8").splitlines()
    day.check("the table has the corrected count", len(rows) - 1 == count_standing())


def review_orchard(hand: Hand, day: Day) -> Steps:
    """Open a block of trees, review one of them, and update the tables."""
    overview = hand.window.scene = bpy.data.scenes.new("Orchard")
    settings().block.folder = str(make_block(Path(bpy.path.abspath(result_folder()))))
    yield 0.5
    yield from hand.push("fruitlangs.open_block")
    yield from wait_for_work(hand)
    trees = overview.fruitlangs.block.trees
    day.check("all trees are shown", [tree.counted > 0 for tree in trees] == [True] * COPIES + [False])
    yield from hand.find("fruitlangs.block.colors")  # the last button: all are visible
    yield from take_picture(hand, day, "orchard")
    yield from hand.push("fruitlangs.open_tree")
    yield from wait_for_work(hand)
    day.check("the tree has a scene of its own", hand.window.scene != overview and count_standing() == trees[0].counted)
    yield from hand.push("fruitlangs.next_uncertain")
    yield from hand.push("fruitlangs.reject_fruit")
    yield from hand.push("fruitlangs.show_block")
    yield from hand.push("fruitlangs.update_block")
    yield from wait_for_work(hand)
    trees = overview.fruitlangs.block.trees
    day.check("the tables have the review", trees[0].reviewed == trees[0].counted - 1)


def result_folder() -> str:
    """The folder of the day's result."""
    return next(scene.fruitlangs.result.folder for scene in bpy.data.scenes if scene.fruitlangs.result.folder)


def make_block(result: Path) -> Path:
    """Make a block with copies of a result in two rows, and a tree that failed."""
    from fruitlangs.engine.block.inputs import read_inputs
    from fruitlangs.engine.block.ledger import Ledger, TreeState
    from fruitlangs.engine.block.manifest import TreeEntry
    from fruitlangs.engine.block.publish import publish_block

    ledger = Ledger(result.parent / "block")
    trees = [
        TreeEntry(id=f"{'AB'[k // 4]}{k % 4 + 1}", source=result, prompt=("apple",), row="AB"[k // 4], position=k % 4)
        for k in range(COPIES + 1)
    ]
    ledger.write_trees(trees)
    for tree in trees[:COPIES]:
        shutil.copytree(result, ledger.result(tree).path, dirs_exist_ok=True)
        ledger.write(tree, TreeState(stage="done", fingerprint=tree.fingerprint, inputs=read_inputs(tree)))
    lost = TreeState(stage="failed", fingerprint=trees[-1].fingerprint, reason=f"{trees[-1].id} has 2 photos")
    ledger.write(trees[-1], lost)
    publish_block(ledger)
    return ledger.path


def find_running_job() -> Any:
    from fruitlangs.operators.jobs import jobs

    return jobs.find_running_job()


def wait_for_work(hand: Hand) -> Steps:
    """Wait until no job is running and its result is shown."""
    yield from hand.rest()
    while find_running_job() is not None:
        yield WAIT
    yield 4 * WAIT


def take_picture(hand: Hand, day: Day, name: str, *, rest: bool = True) -> Steps:
    """Take a picture, with the pointer out of the way unless a dialog would close."""
    if day.pictures is not None:
        if rest:
            yield from hand.rest()
        yield from hand.save_shot(day.pictures / f"{name}.jpg")
    yield MOMENT


PARTS: Mapping[Callable[[Hand, Day], Steps], str] = {
    import_scene: "Import: the photos with their cameras, and sparse points",
    measure: "Measure: two clicks and a length give the scale",
    reconstruct: "Reconstruct: 3D Gaussians are trained; Esc stops, and the next start goes on",
    ask: "Ask: the Gaussians that match a word light up",
    teach: "Teach: two clicks on fruit and one on a leaf teach a new word",
    count: "Count: each fruit is an object with a size and a probability",
    review: "Review: go to uncertain fruit, look at the photo, reject, split, merge, add",
    export: "Export: a table of the reviewed fruit",
    review_orchard: "Orchard: all trees of a block, their counts, and the review of one",
}
"""{a part of the day: its caption in the film}, in order."""
