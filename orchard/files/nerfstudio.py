"""A finished scene in nerfstudio's layout as FruitNeRF reads it: transforms.json, semantics/ and a point cloud."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from . import png

CLOUD = "sparse_pc.ply"


def write_nerfstudio(out: Path) -> None:
    """Write transforms.json, semantics/NNN.png (255 on fruit, else 0) and sparse_pc.ply from the scene's own files.

    Poses are those of sparse/0, camera to world with OpenGL axes (x right, y up, z backward), in the same frame.
    """
    import pycolmap

    model = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    (out / "semantics").mkdir(exist_ok=True)
    frames = []
    for image in sorted(model.images.values(), key=lambda each: each.name):
        mask = f"semantics/{Path(image.name).stem}.png"
        ids = png.read_grey(out / "instances" / Path(mask).name)
        png.write_grey(out / mask, np.where(ids > 0, 255, 0).astype(np.uint8))
        matrix = np.eye(4)
        matrix[:3] = image.cam_from_world().inverse().matrix()
        matrix[:3, 1:3] *= -1.0
        frames.append({"file_path": f"images/{image.name}", "semantic_path": mask, "transform_matrix": matrix.tolist()})
    (camera,) = model.cameras.values()
    fx, fy, cx, cy = camera.params
    document = {
        "camera_model": "OPENCV",
        **{"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy},
        **{"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0},
        "ply_file_path": CLOUD,
        "semantics": ["fruit"],
        "frames": frames,
    }
    points = [model.points3D[i] for i in sorted(model.points3D)]
    xyz = np.array([p.xyz for p in points]).reshape(-1, 3)
    _write_cloud(out / CLOUD, xyz, np.array([p.color for p in points]).reshape(-1, 3).astype(np.uint8))
    half_made = out / "transforms.json.part"
    half_made.write_text(json.dumps(document, indent=1) + "\n")
    os.replace(half_made, out / "transforms.json")


def _write_cloud(path: Path, xyz: np.ndarray, colors: np.ndarray) -> None:
    """Coloured points as a binary .ply."""
    names = "xyz"
    rows = np.empty(len(xyz), dtype=[*((n, "<f4") for n in names), *((n, "u1") for n in ("red", "green", "blue"))])
    for i, name in enumerate(names):
        rows[name] = xyz[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, i]
    properties = [*(f"property float {n}" for n in names), *(f"property uchar {n}" for n in ("red", "green", "blue"))]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header", ""]
    half_made = path.with_name(path.name + ".part")
    half_made.write_bytes("\n".join(lines).encode() + rows.tobytes())
    os.replace(half_made, path)
