"""Grey PNG pictures of 8 or 16 bits, written and read without an image library (Blender's Python has none)."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_grey(path: Path, values: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write (H, W) values of uint8 or uint16 as they are (PNG specification, section 11)."""
    height, width = values.shape
    depth = 8 * values.dtype.itemsize
    big_endian = values.astype(values.dtype.newbyteorder(">"), copy=False)
    rows = big_endian.tobytes()
    stride = len(rows) // height
    raw = b"".join(b"\0" + rows[i * stride : (i + 1) * stride] for i in range(height))
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(raw, 9)),
        (b"IEND", b""),
    ]
    out = b"\x89PNG\r\n\x1a\n"
    for kind, data in parts:
        out += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    half_made = path.with_name(path.name + ".part")
    half_made.write_bytes(out)
    os.replace(half_made, path)


def read_grey(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """The values (H, W) of a picture written by `write_grey`."""
    content, at, raw = path.read_bytes(), 8, b""
    width, height, depth = struct.unpack(">IIB", content[16:25])
    while at < len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        if content[at + 4 : at + 8] == b"IDAT":
            raw += content[at + 8 : at + 8 + length]
        at += 12 + length
    rows = np.frombuffer(zlib.decompress(raw), dtype=np.uint8).reshape(height, 1 + width * depth // 8)[:, 1:]
    values = rows.copy().view(">u2" if depth == 16 else "u1").reshape(height, width)
    return values.astype(np.uint16) if depth == 16 else values.astype(np.uint8)
