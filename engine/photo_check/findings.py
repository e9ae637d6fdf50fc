"""What each measure of the photos means for the user, in plain sentences with what to do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from ..config import Config, SceneConfig
from ..counting.accounts.zero import ENOUGH_PIXELS, LEAST_PIXELS
from ..photo_size import CLOSER, MOST, NARROW
from ..scene.sfm.job import LEAST_PHOTOS
from .cost import StageCost, side_read
from .examine import Examined
from .exposure import COLOUR_STEP, EXPOSURE_STEP, changes, most_involved
from .finding import Finding, list_names, photos_text
from .links import Links, Pair
from .photo_files import PhotoFiles
from .sharpness import SOFT, find_blurred

GOOD_PHOTOS = 40
LEAST_KNOWN = 6.0
"""Width in pixels below which fruit and noise look alike."""
STILL = 0.004
"""Median shift of common content, in longer sides of the photo, below which the camera did not move."""
MOST_ALIKE = 0.8
"""Share of consecutive photos without movement above which all photos are alike."""


def check_files(files: PhotoFiles, unreadable: Mapping[str, str]) -> list[Finding]:
    """Return findings on RAW files and files that cannot be read; unreadable: {name: reason}."""
    found = []
    stems = {photo.stem for photo in files.photos}
    alone = [raw.name for raw in files.raw if raw.stem not in stems]
    if alone:
        found.append(
            Finding(
                kind="RAW",
                severity="problem",
                sentence=f"{photos_text(len(alone))} are RAW files, which are not read: {list_names(alone)}",
                advice="Convert them to JPEG with the camera's program, darktable or RawTherapee",
                photos=alone,
            )
        )
    elif files.raw:
        found.append(
            Finding(
                kind="RAW",
                severity="warning",
                sentence=f"{len(files.raw)} RAW files are not read, photos of the same names are used instead",
                advice="Nothing needs to be done",
            )
        )
    if unreadable:
        names = list(unreadable)
        found.append(
            Finding(
                kind="unreadable",
                severity="problem",
                sentence=f"{photos_text(len(names))} cannot be read: {list_names(names)} ({unreadable[names[0]]})",
                advice="Copy them again from the camera, save them as JPEG, or remove them",
                photos=names,
            )
        )
    return found


def check_number(count: int) -> list[Finding]:
    """Return findings on too few photos."""
    if count >= GOOD_PHOTOS:
        return []
    return [
        Finding(
            kind="few photos",
            severity="problem" if count < LEAST_PHOTOS else "warning",
            sentence=f"There are only {photos_text(count)}" if count != 1 else "There is only 1 photo",
            advice=f"Take {GOOD_PHOTOS} or more around the tree, 5 to 10° apart",
        )
    ]


def check_overlap(names: Sequence[str], photos: Sequence[Examined], links: Links) -> list[Finding]:
    """Return findings on photos that show the same, nothing in common, or leave gaps."""
    if len(photos) < 2:
        return []
    if _all_alike(photos, links):
        return [
            Finding(
                kind="all alike",
                severity="problem",
                sentence="The photos are all alike: the camera did not move between them",
                advice="Walk around the tree, and take each photo from another position",
            )
        ]
    if len(photos) < LEAST_PHOTOS:
        return []
    if not links.large_groups:
        return [
            Finding(
                kind="no overlap",
                severity="problem",
                sentence=f"The {len(photos)} photos show too little common content",
                advice="Take the photos in smaller steps, 5 to 10° apart, so that neighbours overlap by 70 %",
                photos=names,
            )
        ]
    return [*_groups(names, links), *_find_gaps(names, links), *_find_lone(names, links)]


def _all_alike(photos: Sequence[Examined], links: Links) -> bool:
    still = [
        (link := links.links.get((i, i + 1))) is not None
        and np.median(
            np.linalg.norm(photos[i].features.points[link.first] - photos[i + 1].features.points[link.second], axis=1)
        )
        < STILL * photos[i].features.longer_side
        for i in range(len(photos) - 1)
    ]
    return float(np.mean(still)) >= MOST_ALIKE


def _groups(names: Sequence[str], links: Links) -> list[Finding]:
    groups = links.large_groups
    if len(groups) < 2:
        return []
    parts = [f"{len(group)} from {names[group[0]]} to {names[group[-1]]}" for group in groups]
    breaks = [f"{names[i]} and {names[j]}" for i, j in _find_breaks(links)]
    between = f"between {' and between '.join(breaks)}" if len(breaks) < len(groups) else "between the groups"
    return [
        Finding(
            kind="groups",
            severity="problem",
            sentence=f"The photos form {len(groups)} groups without common content: {'; '.join(parts)}",
            advice="If they show different trees or places, put each group into its own folder. If they show one tree,"
            f" take the photos that are missing {between}",
            photos=[names[photo] for group in groups[1:] for photo in group],
        )
    ]


def _find_breaks(links: Links) -> list[Pair]:
    """Find consecutive photos of different groups."""
    group_of = {photo: number for number, group in enumerate(links.groups) for photo in group}
    return [(i, j) for i, j in links.gaps if group_of[i] != group_of[j]]


def _find_gaps(names: Sequence[str], links: Links) -> list[Finding]:
    """Find gaps inside a group, whose photos are linked the other way around the tree."""
    gaps = sorted(set(links.gaps) - set(_find_breaks(links)))
    if not gaps:
        return []
    places = [f"{names[i]} and {names[j]}" for i, j in gaps]
    where = f"a gap between {places[0]}" if len(gaps) == 1 else f"{len(gaps)} gaps: between {list_names(places)}"
    return [
        Finding(
            kind="gap",
            severity="warning",
            sentence=f"The walk has {where}. These photos do not overlap",
            advice="Take photos from the positions between them, 5 to 10° apart",
            photos=[names[photo] for photo in sorted({each for gap in gaps for each in gap})],
        )
    ]


def _find_lone(names: Sequence[str], links: Links) -> list[Finding]:
    lone = [names[photo] for photo in links.lone]
    if not lone:
        return []
    overlap = "overlaps" if len(lone) == 1 else "overlap"
    return [
        Finding(
            kind="no overlap",
            severity="warning",
            sentence=f"{photos_text(len(lone))} {overlap} with too few others: {list_names(lone)}",
            advice="Remove them if they are blurred or show something else, or take more photos near them",
            photos=lone,
        )
    ]


def check_sharpness(names: Sequence[str], photos: Sequence[Examined]) -> list[Finding]:
    """Return findings on blurred photos."""
    values = [photo.sharpness for photo in photos]
    if not values:
        return []
    found = []
    if float(np.median(values)) < SOFT:
        found.append(
            Finding(
                kind="soft",
                severity="warning",
                sentence="Most photos are soft: they have little fine detail for their size",
                advice="Focus on the tree, hold the camera still, and clean the lens. Photos of a smaller size are as"
                " good and faster (--scene.max-side 800)",
            )
        )
    blurred = [name for name, each in zip(names, find_blurred(values), strict=True) if each]
    if blurred:
        are = "is" if len(blurred) == 1 else "are"
        found.append(
            Finding(
                kind="blur",
                severity="warning",
                sentence=f"{photos_text(len(blurred))} {are} blurred compared with the others: {list_names(blurred)}",
                advice="Remove them if their neighbours overlap, or take them again. Stand still for each photo",
                photos=blurred,
            )
        )
    return found


def check_light(names: Sequence[str], photos: Sequence[Examined], links: Links) -> list[Finding]:
    """Return findings on changes of exposure and white balance between photos of the same content."""
    found = changes(links.links, [photo.colors for photo in photos])
    findings = []
    jumps = {pair: abs(change.exposure) for pair, change in found.items() if abs(change.exposure) > EXPOSURE_STEP}
    if jumps:
        photos_of = [names[photo] for photo in most_involved(sorted(jumps))]
        findings.append(
            Finding(
                kind="exposure",
                severity="warning",
                sentence=f"The brightness of the same leaves jumps by up to {max(jumps.values()):.1f} stops at "
                f"{photos_text(len(photos_of))}: {list_names(photos_of)}",
                advice="Lock the exposure (AE lock, or manual mode), or count with --train.exposure",
                photos=photos_of,
            )
        )
    shifts = {pair: abs(change.colour) for pair, change in found.items() if abs(change.colour) > COLOUR_STEP}
    if shifts:
        photos_of = [names[photo] for photo in most_involved(sorted(shifts))]
        findings.append(
            Finding(
                kind="white balance",
                severity="warning",
                sentence=f"The colour of the same leaves shifts at {photos_text(len(photos_of))}: "
                f"{list_names(photos_of)}",
                advice="Set a fixed white balance, or count with --train.exposure",
                photos=photos_of,
            )
        )
    return findings


def check_cameras(names: Sequence[str], photos: Sequence[Examined]) -> list[Finding]:
    """Return findings on photos of several cameras, sizes or orientations."""
    found = []
    cameras = [_camera(photo) for photo in photos]
    if len(set(cameras)) > 1:
        counts = Counter(cameras).most_common()
        usual = counts[0][0]
        parts = [f"{number} of {camera}" for camera, number in counts[:4]]
        more = f"; and {len(counts) - 4} other kinds" if len(counts) > 4 else ""
        found.append(
            Finding(
                kind="cameras",
                severity="warning",
                sentence=f"The photos are of {len(counts)} cameras, sizes or focal lengths: {'; '.join(parts)}{more}",
                advice="Use one camera at one focal length, without zoom and without cropping. If they are of different"
                " walks, count each walk separately",
                photos=[name for name, camera in zip(names, cameras, strict=True) if camera != usual],
            )
        )
    wide = [photo.width >= photo.height for photo in photos]
    if len(set(wide)) > 1:
        mostly = _most_common(wide)
        turned = [name for name, each in zip(names, wide, strict=True) if each != mostly]
        found.append(
            Finding(
                kind="orientation",
                severity="warning",
                sentence=f"{sum(wide)} photos are landscape and {len(wide) - sum(wide)} are portrait",
                advice="Hold the camera the same way up for all photos. Otherwise use --photos.no-upright",
                photos=turned,
            )
        )
    return found


def _camera(photo: Examined) -> str:
    """'iPhone 12, 26 mm, 4032×3024', with the longer side first."""
    focal = f"{photo.camera.focal:g} mm" if photo.camera.focal else ""
    size = f"{max(photo.width, photo.height)}×{min(photo.width, photo.height)}"
    return ", ".join(part for part in (photo.camera.model, focal, size) if part)


def _most_common(values: Sequence[Hashable]) -> Hashable:
    return Counter(values).most_common(1)[0][0]


def check_memory(costs: Sequence[StageCost], free: int) -> list[Finding]:
    """Return a finding if a stage needs more bytes than are free."""
    worst = max(costs, key=lambda cost: cost.bytes, default=None)
    if worst is None or worst.bytes <= free:
        return []
    return [
        Finding(
            kind="memory",
            severity="problem",
            sentence=f"{worst.stage.capitalize()} needs about {worst.bytes / 2**30:.1f} GB of memory and "
            f"{free / 2**30:.1f} GB are free",
            advice="Close other programs, or use smaller photos (--scene.downscale 2 and --photos.max-side 800)",
        )
    ]


def check_fruit(share: float | None, sizes: Sequence[tuple[int, int]], config: Config) -> list[Finding]:
    """Return a finding if fruit will be narrow; share: of the longer side of a photo, None if it is not known; sizes:
    (width, height) of the photos in pixels."""
    if share is None or not sizes:
        return []
    longest = float(np.median([max(size) for size in sizes]))
    read = side_read(longest, config)
    if config.scene.max_side == SceneConfig().max_side:  # narrow fruit are read larger without being asked
        read = min(MOST * read, longest / config.scene.downscale)
    width = share * read
    if not LEAST_KNOWN <= width < NARROW:
        return []
    enough = share * longest >= NARROW
    advice = f"Read the photos larger with --scene.max-side {longest:.0f}" if enough else CLOSER
    return [
        Finding(
            kind="narrow fruit",
            severity="warning" if width >= LEAST_PIXELS else "problem",
            sentence=f"The fruit are about {width:.0f} pixels wide in the photos as read ({share:.1%} of the longer "
            f"side), and {ENOUGH_PIXELS:.0f} are needed: fruit will be missing",
            advice=advice,
        )
    ]
