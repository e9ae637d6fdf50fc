"""The places of a block as a GeoPackage, which GIS programs edit and store."""

from __future__ import annotations

from pathlib import Path

from ..errors import OutputError
from ..storage.files import replace_file

GEOPACKAGE, LAYER = "orchard.gpkg", "trees"


def write_geopackage(places: Path) -> list[Path]:
    """Write orchard.gpkg next to a GeoJSON file, with its points in the layer `trees`; returns the written file. None
    is written, and an earlier one is removed, if the package pyogrio is missing or no tree has a place.

    Raises:
        OutputError: it cannot be written.
    """
    path = places.with_name(GEOPACKAGE)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be replaced ({error.strerror or error}). Close the program that shows it"
        ) from error
    try:
        from pyogrio import raw
    except ImportError:
        return []
    try:
        about, _, points, columns = raw.read(places)
        if not len(points):
            return []
        with replace_file(path) as temporary:
            raw.write(
                temporary, points, columns, about["fields"], driver="GPKG", layer=LAYER,
                geometry_type="Point", crs="EPSG:4326",
            )  # fmt: skip
    except RuntimeError as error:  # of pyogrio
        raise OutputError(f"{path} cannot be written ({error}). Choose another output folder") from error
    return [path]
