"""A film of the day: pictures of the window with the pointer and a caption, as an animated WebP file."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from PIL import Image, ImageChops, ImageDraw, ImageFont, ImageStat

from guide.hand import Hand, Steps

WIDTH, BAR = 1000, 36
"""Pixels: of a picture across, and of the bar below it that holds the caption."""
SECONDS, LONGEST = 90.0, 0.6
"""Seconds of the whole film, and the longest that one picture is shown."""
EVERY, EVERY_AT_WORK = 0.8, 4.0
"""Seconds between two pictures, and while a job runs."""
CHANGED = 0.02
"""Mean difference of two pictures, of 255 levels, below which the second is left out."""
LAST = 3.0
"""Seconds for which the last picture is shown."""
QUALITY = 60


class Film:
    """Pictures of the window of a hand. caption: what is being done."""

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self.caption = ""
        self._pictures: list[Image.Image] = []
        self._looked = 0.0

    def record(self, steps: Steps, working: Callable[[], bool]) -> Steps:
        """Pass on the same steps, with a picture now and then. working: whether a job runs."""
        for pause in steps:
            yield pause
            if time.monotonic() - self._looked > (EVERY_AT_WORK if working() else EVERY):
                self._look()
                self._looked = time.monotonic()

    def _look(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "window.png"
            self._hand.draw_window(path)
            with Image.open(path) as drawn:
                window = drawn.convert("RGB")
        share = WIDTH / window.width
        picture = Image.new("RGB", (WIDTH, round(share * window.height) + BAR), "#1d1d1d")
        picture.paste(window.resize((WIDTH, picture.height - BAR), Image.Resampling.LANCZOS))
        draw = ImageDraw.Draw(picture)
        x, y = self._hand.mouse[0] * share, (window.height - self._hand.mouse[1]) * share
        draw.polygon([(x, y), (x, y + 17), (x + 4, y + 13), (x + 11, y + 12)], fill="white", outline="black")
        draw.text((14, picture.height - BAR + 8), self.caption, fill="white", font=ImageFont.load_default(18))
        if self._pictures:
            difference = ImageChops.difference(self._pictures[-1], picture)
            if sum(ImageStat.Stat(difference).mean) / 3.0 < CHANGED:
                return
        self._pictures.append(picture)

    def write(self, path: Path) -> None:
        """Write the film; each picture is shown equally long, the last one longer."""
        each = min(SECONDS / len(self._pictures), LONGEST)
        times = [round(1000 * each)] * (len(self._pictures) - 1) + [round(1000 * LAST)]
        first, *others = self._pictures
        path.parent.mkdir(parents=True, exist_ok=True)
        first.save(path, save_all=True, append_images=others, duration=times, loop=0, quality=QUALITY, method=4)
        seconds = sum(times) / 1000
        print(f"{path}: {len(times)} pictures, {seconds:.0f} s, {path.stat().st_size / 1e6:.1f} MB", flush=True)
