"""Views of Gaussians on a graphics card: the stages of `rendering.render`, on buffers that stay there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import GpuError
from ...scene.camera import Camera
from ..gaussians import PARAMETERS
from ..kernels.adam import CORRECTIONS
from ..kernels.loss import W0, W1, W2, W3, W4, W5
from ..kernels.project_backward import USED_MOMENTS
from ..kernels.records import RECORD
from ..kernels.surface import NOTHING
from ..kernels.tile import CHANNELS
from ..rendering.render import DrawRules, camera_values
from .card import Card, Program, Recording

TILE = 16
SORTED_AT_ONCE = 4096
"""Keys that one workgroup of the sort takes."""
DIGITS = 256
PLAN = 16
"""32-bit values of the kernels' `Plan`."""
NEEDED, FULL, TAKEN, SORT_GROUPS, ENTRY_GROUPS = 2, 3, 5, 8, 12
"""Their places in it."""
SLOTS = 20
"""Steps of training whose results the card keeps until the host fetches them."""
COLORS, POSE = 12, 15
"""Numbers of the gradient of a photo's exposure, and of a camera's pose (`poses.twist_gradient`)."""
SAME_IMAGE = 1e-4
"""Mean difference of a view's colours up to which a card agrees with the CPU. Rounding moves a Gaussian's edge by a
pixel here and there; anything wrong is far above."""
SPARE = 1.5
"""Room for pairs beyond those of the fullest view so far."""
CONSTANTS = {
    **{f"W{k}": float(weight) for k, weight in enumerate((W0, W1, W2, W3, W4, W5))},
    "NOTHING": float(NOTHING),
}
"""Numbers that the kernels share with those of the CPU."""

_BACKWARD = ("view", "gaussian", "record", "harmonics", "project_backward")
PROGRAMS = {
    "near_plane": ("view", "near_plane"),
    "project": ("view", "gaussian", "record", "harmonics", "project"),
    "radix": ("view", "scan", "radix"),
    "lists": ("view", "scan", "lists"),
    "pairs": ("view", "record", "pairs"),
    "blend": ("view", "blend"),
    "loss": ("view", "loss"),
    "exposure": ("view", "total", "exposure"),
    "load": ("view", "total", "load"),
    "blend_backward": ("view", "blend_backward"),
    "keep": (*_BACKWARD, "keep_gradients"),
    "adam": (*_BACKWARD, "adam"),
    "pose": ("view", "total", "pose"),
    "hold": ("view", "hold"),
    "blended": ("view", "blended"),
    "accumulate": ("view", "accumulate"),
}
"""{program: the files of `wgsl` that it is made of}."""

VIEW = np.dtype(
    [
        ("camera", np.float32, 21),
        ("pair_alpha", np.float32),
        ("background", np.float32, 3),
        ("count", np.uint32),
        ("degree", np.uint32),
        ("antialiased", np.uint32),
        ("literal", np.uint32),
        ("width", np.uint32),
        ("height", np.uint32),
        ("columns", np.uint32),
        ("rows", np.uint32),
        ("capacity", np.uint32),
        ("with_depth", np.uint32),
        ("with_mean_gradients", np.uint32),
        ("l1_weight", np.float32),
        ("ssim_weight", np.float32),
        ("rates", np.float32, 6),
        ("opacity_weight", np.float32),
        ("scale_weight", np.float32),
        ("flatness_weight", np.float32),
        ("middle", np.float32, 3),
        ("extent", np.float32),
        ("slot", np.uint32),
        ("with_pose", np.uint32),
        ("load_share", np.float32),
        ("exposure", np.float32, 12),
        ("channels", np.uint32),
    ]
)
"""The kernels' `View`: what a view and its step are given."""


@dataclass(frozen=True)
class Size:
    """Of a view. width, height: pixels."""

    width: int
    height: int

    @property
    def columns(self) -> int:
        """Tiles in a row."""
        return -(-self.width // TILE)

    @property
    def rows(self) -> int:
        return -(-self.height // TILE)

    @property
    def tiles(self) -> int:
        return self.columns * self.rows


def size_of(view: NDArray[Any]) -> Size:
    """Of a `VIEW`."""
    return Size(int(view["width"][0]), int(view["height"][0]))


def pack_photo(pixels: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> NDArray[np.uint32]:
    """Pack a photo (H, W, 3) as the kernels read it, (H, W): 8 bits a colour, and 255 where it may be used, mask (H,
    W)."""
    rows = pixels.astype(np.uint32)
    usable = np.ones(rows.shape[:2], bool) if mask is None else mask
    whole = rows[..., 0] | rows[..., 1] << 8 | rows[..., 2] << 16 | np.where(usable, 255 << 24, 0)
    return np.asarray(whole, np.uint32)


def columns_of(parameters: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """(columns, N) the parameters, or anything of their shapes, as the kernels read them: a row for each number of a
    Gaussian."""
    n = len(parameters["means"])
    return np.concatenate([parameters[name].reshape(n, -1).T for name in PARAMETERS])


def parameters_of(columns: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """The reverse of `columns_of`."""
    rows = np.ascontiguousarray(columns.T)
    n, terms = len(rows), (rows.shape[1] - 11) // 3
    shapes = {"means": (0, 3), "log_scales": (3, 6), "quats": (6, 10), "opacity_logits": (10, 11), "sh": (11, None)}
    tables = {name: np.ascontiguousarray(rows[:, slice(*place)]) for name, place in shapes.items()}
    return {**tables, "opacity_logits": tables["opacity_logits"][:, 0], "sh": tables["sh"].reshape(n, terms, 3)}


def view_of(camera: Camera, rules: DrawRules, count: int) -> NDArray[Any]:
    """(1,) `VIEW` of a camera for this many Gaussians; the rest is 0."""
    size = Size(camera.width, camera.height)
    view = np.zeros(1, VIEW)
    view["camera"] = camera_values(camera)
    view["pair_alpha"], view["count"], view["degree"] = rules.pair_alpha, count, rules.sh_degree
    view["antialiased"], view["literal"] = rules.antialiased, rules.literal_pairs
    view["width"], view["height"], view["columns"], view["rows"] = size.width, size.height, size.columns, size.rows
    return view


@dataclass(frozen=True, eq=False)
class Computed:
    """What a card computed of one view, with its losses and gradients in slot 0.

    planes: (CHANNELS, H, W) as `kernels.blend` writes them; gradients: of the parameters by name, of `offsets` (N, 2),
    and as `mean_gradients` (N, 2) the sums of their absolute values, as `render.view_backward` gives them; empty if not
    asked for. Of a Gaussian that was not drawn they are 0. sums: of L1 and SSIM over the colours of all pixels that may
    be used, if a photo was given.
    """

    planes: NDArray[np.float32]
    gradients: Mapping[str, NDArray[np.float32]]
    sums: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Learnt:
    """What training changes: the parameters and Adam's moments of them, by name; updates: (N,) int32 of each Gaussian;
    pulls: (N, 2) sums and counts of `GradientStats`."""

    values: Mapping[str, NDArray[np.float32]]
    first: Mapping[str, NDArray[np.float32]]
    second: Mapping[str, NDArray[np.float32]]
    updates: NDArray[np.int32]
    pulls: NDArray[np.float32]


class Canvas:
    """Draws views of the Gaussians in the buffer "values" of a card, as `columns_of` lays them out."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self.capacity = 1 << 16
        self._passes = [
            [card.upload(f"pass {kind} {k}", np.array([8 * k, kind, k == 0], np.uint32)) for k in range(4)]
            for kind in (0, 1)
        ]
        card.upload("plan", np.zeros(PLAN, np.uint32))
        for name, values in (("losses", 2), ("color_sums", COLORS), ("pose_sums", POSE)):
            card.buffer(name, SLOTS * values)

    def program(self, name: str) -> Program:
        """A program of `PROGRAMS`, compiled when it is first used."""
        return self.card.program(*PROGRAMS[name], **CONSTANTS)

    def make_room(self, pairs: int) -> None:
        """Make room for a view with more pairs than there was room for."""
        self.capacity = max(self.capacity, int(SPARE * pairs))

    def reserve(self, count: int, size: Size) -> None:
        """Make room for this many Gaussians in a view of this size."""
        card = self.card
        blocks = -(-max(count, self.capacity) // SORTED_AT_ONCE)
        sizes = {
            "records": RECORD * count,
            "counts": count,
            "starts": count,
            "keys": count,
            "keys other": count,
            "order": count,
            "order other": count,
            "block_sums": blocks,
            "histogram": DIGITS * blocks,
            "totals": DIGITS,
            "tile_of": self.capacity,
            "tile_of other": self.capacity,
            "owner_of": self.capacity,
            "pair_of": self.capacity,
            "pair_of other": self.capacity,
            "tile_starts": size.tiles + 1,
            "planes": CHANNELS * size.width * size.height,
        }
        for name, values in sizes.items():
            card.buffer(name, values)

    def reserve_backward(self, count: int, columns: int, view: NDArray[Any]) -> None:
        """Make room for what learning from a view needs as well. columns: numbers of a Gaussian."""
        size = size_of(view)
        pixels, exposed = size.width * size.height, bool(view["exposure"].any())
        sizes = {
            "moments": USED_MOMENTS * self.capacity,
            "gradients": 5 * pixels,
            "slopes": 9 * pixels,
            "partial": 6 * size.tiles,
            "updates": count,
            "pulls": 2 * count,
            "values": columns * count,
            "first": columns * count,
            "second": columns * count,
            "d_pose": POSE * count if view["with_pose"][0] else 1,
            "loads": pixels if view["load_share"][0] > 0.0 else 1,
            "load_partial": size.tiles,
            "load_total": 2,
            "exposed": 3 * pixels if exposed else 1,
            "color_partial": COLORS * size.tiles if exposed else 1,
        }
        for name, values in sizes.items():
            self.card.buffer(name, values)

    def draw(self, work: Recording, count: int, size: Size) -> None:
        """From "values" and "view" to "planes", (CHANNELS, H, W)."""
        held = self._copy_buffers()
        work.stage("project")
        work.run(self.program("near_plane"), "near_plane", held, 1)
        work.run_for(self.program("project"), "project", held, count)
        work.stage("sort")
        self._sort(work, 0, 32, "keys", "order", held, -(-count // SORTED_AT_ONCE))
        blocks = -(-count // SORTED_AT_ONCE)
        work.run(self.program("lists"), "offsets_sum", held, blocks)
        work.run(self.program("lists"), "offsets_scan", held, 1)
        work.run(self.program("lists"), "offsets_write", held, blocks)
        work.clear(held["tile_starts"])
        work.run_for(self.program("pairs"), "list_pairs", held, count)
        tile_of, pair_of = self._sort(work, 1, size.tiles.bit_length(), "tile_of", "pair_of", held)
        held["tile_of"], held["pair_of"] = held[tile_of], held[pair_of]
        work.run_planned(self.program("pairs"), "cut_lists", held, held["plan"], ENTRY_GROUPS)
        work.stage("blend")
        work.run(self.program("blend"), "blend", held, size.columns, size.rows)

    def compare(self, work: Recording, view: NDArray[Any], photo: Any) -> None:
        """The loss of "planes" against a photo (H, W), to "losses", and its gradient, to "gradients" (5, H, W); that of
        the view's exposure to "color_sums"."""
        size, program, held = size_of(view), self.program("loss"), {**self._copy_buffers(), "photo": photo}
        exposed, exposure = bool(view["exposure"].any()), self.program("exposure")
        held["image"] = held["exposed" if exposed else "planes"]
        work.stage("loss")
        work.clear(held["gradients"])
        if exposed:
            work.run_for(exposure, "expose", held, size.width * size.height)
        work.run(program, "ssim", held, size.columns, size.rows, 3)
        work.run(program, "ssim_backward", held, size.columns, size.rows, 3)
        if exposed:
            work.run(exposure, "exposure_backward", held, size.columns, size.rows)
            work.run(exposure, "exposure_total", held, COLORS)
        work.run(program, "loss_total", held, 1)

    def backward(self, work: Recording, view: NDArray[Any], into: str) -> None:
        """From "planes" and "gradients" (5, H, W) to what happens with the gradients of the Gaussians. into: "keep"
        writes them to "d_values" and "d_screen", "adam" takes a step. That of the pose goes to "pose_sums"."""
        size, count = size_of(view), int(view["count"][0])
        held = self.list_buffers(size)
        work.stage("backward")
        if view["load_share"][0] > 0.0:
            work.run(self.program("load"), "measure_loads", held, size.columns, size.rows)
            work.run(self.program("load"), "load_statistics", held, 1)
        work.run(self.program("blend_backward"), "blend_backward", held, size.columns, size.rows)
        work.stage("optimiser")
        work.run_for(self.program(into), "project_backward", held, count)
        if view["with_pose"][0]:
            work.run(self.program("pose"), "sum_pose", held, POSE)

    def show(self, parameters: Mapping[str, NDArray[np.float32]]) -> None:
        """Bring Gaussians to the card.

        Raises:
            GpuError: the card failed, or its memory does not suffice.
        """
        self.card.upload("values", columns_of(parameters))

    def list_buffers(self, size: Size) -> dict[str, Any]:
        """List all buffers by name, "pair_of" as the last view of this size sorted it."""
        held = self._copy_buffers()
        return {**held, "pair_of": held[self._sorted_name(size.tiles.bit_length(), "pair_of")]}

    def put(self, learnt: Learnt) -> None:
        """Bring what is learnt to the card.

        Raises:
            GpuError: the card failed, or its memory does not suffice.
        """
        for name in ("values", "first", "second"):
            self.card.upload(name, columns_of(getattr(learnt, name)))
        self.card.upload("updates", learnt.updates)
        self.card.upload("pulls", learnt.pulls)
        self.card.upload("corrections", CORRECTIONS)
        self.card.upload("plan", np.zeros(PLAN, np.uint32))

    def fetch(self, count: int, columns: int) -> Learnt:
        """What was learnt. count: Gaussians; columns: numbers of one.

        Raises:
            GpuError: the card failed.
        """
        values, first, second = (
            parameters_of(self.card.download(name, np.float32, columns * count).reshape(columns, count))
            for name in ("values", "first", "second")
        )
        updates = self.card.download("updates", np.int32, count).copy()
        return Learnt(values, first, second, updates, self.card.download("pulls", np.float32, 2 * count).reshape(-1, 2))

    def learn(self, view: NDArray[Any], photo: Any, *, columns: int, hold: bool = False) -> Recording:
        """Take a step of training for a photo's buffer. hold: then limit the sizes of the Gaussians.

        Raises:
            GpuError: the card failed, or its memory does not suffice.
        """
        count, size = int(view["count"][0]), size_of(view)
        self.reserve(count, size)
        self.reserve_backward(count, columns, view)
        view["capacity"] = self.capacity
        self.card.upload("view", view.view(np.uint32))
        work = self.card.record()
        self.draw(work, count, size)
        self.compare(work, view, photo)
        self.backward(work, view, "adam")
        if hold:
            work.run_for(self.program("hold"), "hold", self._copy_buffers(), count)
        work.submit()
        return work

    def planes(
        self,
        view: NDArray[Any],
        reserve: Callable[[], None] = lambda: None,
        more: Callable[[Recording], None] = lambda _: None,
    ) -> NDArray[np.float32]:
        """(CHANNELS, H, W) the planes of a view, drawn again with more room until all its pairs had room. reserve:
        makes room for what `more` does after the view was drawn.

        Raises:
            GpuError: the card failed, or its memory does not suffice.
        """
        card, count, size = self.card, int(view["count"][0]), size_of(view)
        while True:
            self.reserve(count, size)
            reserve()
            view["capacity"] = self.capacity
            card.upload("view", view.view(np.uint32))
            card.upload("plan", np.zeros(PLAN, np.uint32))
            work = card.record()
            self.draw(work, count, size)
            more(work)
            work.submit()
            plan = card.download("plan", np.uint32, PLAN)
            if not plan[FULL]:
                break
            self.make_room(int(plan[NEEDED]))
        planes = card.download("planes", np.float32, CHANNELS * size.width * size.height)
        return planes.reshape(CHANNELS, size.height, size.width)

    def require_same_image(self, planes: NDArray[np.float32], ours: NDArray[np.float32]) -> None:
        """Refuse a card whose planes of a view are not those of the CPU.

        Raises:
            GpuError: they differ by more than rounding does.
        """
        away = float(np.abs(planes[:3] - ours[:3]).mean())
        if not away <= SAME_IMAGE:
            raise GpuError(f"{self.card.adapter.name} draws another image than the CPU (mean difference {away:.2g})")

    def compute(
        self,
        parameters: Mapping[str, NDArray[np.float32]],
        view: NDArray[Any],
        *,
        photo: NDArray[np.uint32] | None = None,
        pixel_gradients: NDArray[np.float32] | None = None,
    ) -> Computed:
        """Draw one view and, for a photo (see `pack_photo`) or for gradients (5, H, W) of red, green, blue, depth and
        alpha, compute the gradients of the parameters. view: from `view_of`.

        Raises:
            GpuError: the card failed, or its memory does not suffice.
        """
        card, table = self.card, columns_of(parameters)
        columns, count = table.shape
        learns = photo is not None or pixel_gradients is not None
        card.upload("values", table)

        def learn(work: Recording) -> None:
            if photo is not None:
                self.compare(work, view, card.upload("photo", photo))
            if learns:
                work.clear(card.buffers["d_values"])
                self.backward(work, view, "keep")

        def reserve() -> None:
            if learns:
                self.reserve_backward(count, columns, view)
                card.buffer("d_values", columns * count)
                card.buffer("d_screen", 4 * count)
            if pixel_gradients is not None:
                card.upload("gradients", pixel_gradients)

        planes = self.planes(view, reserve, learn)
        gradients: dict[str, NDArray[np.float32]] = {}
        if learns:
            gradients = parameters_of(card.download("d_values", np.float32, table.size).reshape(columns, count))
            screen = card.download("d_screen", np.float32, 4 * count).reshape(count, 4)
            gradients |= {"offsets": screen[:, :2], "mean_gradients": screen[:, 2:]}
        sums = card.download("losses", np.float32, 2) if photo is not None else np.zeros(2, np.float32)
        return Computed(planes, gradients, sums)

    def _copy_buffers(self) -> dict[str, Any]:
        return dict(self.card.buffers)

    @staticmethod
    def _sorted_name(bits: int, name: str) -> str:
        return name if -(-bits // 8) % 2 == 0 else f"{name} other"

    def _sort(
        self, work: Recording, kind: int, bits: int, keys: str, items: str, held: Mapping[str, Any], blocks: int = 0
    ) -> tuple[str, str]:
        """Sort keys of this many bits with their items; returns the names of the buffers that hold them."""
        program, names = self.program("radix"), (keys, items)
        for k in range(-(-bits // 8)):
            others = _other(names[0]), _other(names[1])
            bound = {
                **held, "settings": self._passes[kind][k], "keys": held[names[0]], "items": held[names[1]],
                "sorted_keys": held[others[0]], "sorted_items": held[others[1]],
            }  # fmt: skip
            for entry in ("radix_count", "radix_scan", "radix_scatter"):
                if entry == "radix_scan":
                    work.run(program, entry, bound, DIGITS)
                elif kind == 0:
                    work.run(program, entry, bound, blocks)
                else:
                    work.run_planned(program, entry, bound, held["plan"], SORT_GROUPS)
            names = others
        return names[0], names[1]


def _other(name: str) -> str:
    """The second buffer of a name, between which the sort goes back and forth."""
    return name.removesuffix(" other") if name.endswith(" other") else f"{name} other"
