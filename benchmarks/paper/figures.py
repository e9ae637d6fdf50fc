"""What the paper printed: CountingFruit (FruitLangGS), its tables of reconstruction, counts and ablation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

METHODS = ("NeRF", "FruitNeRF", "Taming3DGS", "3DGS", "FruitLangGS")
COUNTERS = ("NeRF+Ours", "3DGS+Ours", "FruitNeRF (U-Net-B)", "FruitLangGS")
ABLATIONS = ("with language", "without language", "Fruit Field")


@dataclass(frozen=True)
class Printed:
    """One scene. ssim, psnr (dB), lpips, fps: by METHODS, fps as printed; counts: by COUNTERS; ablation: counts by
    ABLATIONS, empty where the paper has none; true: fruit, None where nobody counted."""

    ssim: tuple[float, ...]
    psnr: tuple[float, ...]
    lpips: tuple[float, ...]
    fps: tuple[str, ...]
    counts: tuple[int, ...]
    ablation: tuple[int, ...]
    true: int | None


PRINTED: Mapping[str, Printed] = {
    "Tree01": Printed(
        (0.401, 0.414, 0.529, 0.539, 0.527), (16.402, 16.610, 17.616, 18.072, 17.947),
        (0.713, 0.699, 0.416, 0.472, 0.440), ("<0.5", "<0.5", "277.91", "144.78", "988.86"),
        (140, 154, 173, 173), (173, 141, 158), 179,
    ),
    "Tree02": Printed(
        (0.448, 0.455, 0.598, 0.632, 0.669), (17.907, 18.028, 19.783, 20.708, 20.176),
        (0.670, 0.684, 0.383, 0.275, 0.328), ("<0.5", "<0.5", "88.87", "103.59", "664.44"),
        (88, 98, 112, 110), (110, 93, 101), 113,
    ),
    "Tree03": Printed(
        (0.346, 0.387, 0.524, 0.622, 0.599), (15.323, 15.566, 16.654, 17.746, 17.778),
        (0.686, 0.687, 0.431, 0.299, 0.340), ("<0.5", "<0.5", "469.75", "103.43", "660.29"),
        (136, 194, 264, 287), (287, 204, 251), 291,
    ),
    "Fuji-SfM": Printed(
        (0.603, 0.599, 0.633, 0.693, 0.716), (19.101, 19.698, 19.357, 20.978, 21.454),
        (0.313, 0.295, 0.404, 0.305, 0.295), ("<0.5", "5.82", "196.69", "26.63", "306.88"),
        (991, 1284, 1459, 1443), (1443, 1182, 1327), 1455,
    ),
    "Pfuji-Size_Orch2018": Printed(
        (0.658, 0.673, 0.863, 0.858, 0.867), (20.089, 20.289, 24.389, 24.789, 25.389),
        (0.413, 0.403, 0.113, 0.113, 0.139), ("<0.5", "1.54", "173.23", "107.55", "602.94"),
        (224, 294, 261, 302), (302, 247, 261), 303,
    ),
    "Pfuji-Size_Orch2020": Printed(
        (0.546, 0.561, 0.691, 0.746, 0.749), (16.890, 17.090, 20.890, 20.490, 20.567),
        (0.530, 0.520, 0.330, 0.230, 0.227), ("<0.5", "1.35", "245.82", "131.01", "347.10"),
        (249, 293, 257, 307), (307, 252, 257), 312,
    ),
    "Galafab-west": Printed(
        (0.404, 0.419, 0.559, 0.604, 0.606), (17.398, 17.598, 20.198, 21.150, 20.622),
        (0.663, 0.653, 0.463, 0.363, 0.370), ("<0.5", "1.45", "170.91", "145.91", "1068"),
        (355, 378, 400, 448), (), None,
    ),
    "Schnico-Red-east": Printed(
        (0.462, 0.477, 0.612, 0.662, 0.671), (18.480, 18.680, 21.280, 22.480, 22.142),
        (0.607, 0.597, 0.407, 0.307, 0.324), ("<0.5", "1.47", "172.21", "148.26", "1010"),
        (420, 451, 489, 512), (), None,
    ),
    "Schniga-Schnico-west": Printed(
        (0.333, 0.348, 0.483, 0.533, 0.578), (16.228, 16.428, 18.828, 19.428, 21.790),
        (0.648, 0.638, 0.438, 0.348, 0.315), ("<0.5", "1.44", "164.89", "128.36", "807"),
        (483, 500, 533, 540), (), None,
    ),
}  # fmt: skip
