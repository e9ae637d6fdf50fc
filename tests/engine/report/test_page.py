"""The page: tells the count as every other file does, is one file, and shows text as text."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from fruit_examples import NO_FRUIT, count_of, fruit
from PIL import Image

from fruitlangs.engine.counting.fruit import AuditEntry, Tree
from fruitlangs.engine.errors import OutputError
from fruitlangs.engine.report.histogram import drawing, histogram
from fruitlangs.engine.report.page import Reviewed, write_page
from fruitlangs.engine.report.words import count_text, explain_nothing_found

ROOT = Path(__file__).resolve().parents[3]
TWO = count_of(
    fruit(1, 0.0, fallen=False),
    fruit(7, 1.0, fallen=True),
    interval=(2, 4),
    total=3.2,
    total_interval=(2, 5),
)
STILL = Image.new("RGB", (40, 30), (10, 200, 10))


class Reader(HTMLParser):
    """Collects tags, addresses and shown text."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def page(folder: Path, fruit_count=TWO, **changes) -> Reader:
    settings = {"title": "red apple", "metres_per_unit": None, "still": STILL, **changes}
    write_page(folder / "report.html", fruit_count, **settings)
    reader = Reader()
    reader.feed((folder / "report.html").read_text(encoding="utf-8"))
    return reader


def test_the_page_gives_the_count_in_the_words_of_the_other_files(tmp_path: Path) -> None:
    text = page(tmp_path).text
    assert count_text(TWO) in text
    assert "1 hanging, 1 on the ground" in text


def test_every_fruit_has_its_row(tmp_path: Path) -> None:
    page(tmp_path)
    content = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert re.findall(r"</span>(\d+)</td>", content) == ["1", "7"]


def test_lengths_have_a_unit_that_follows_the_scale(tmp_path: Path) -> None:
    unknown, known = page(tmp_path).text, page(tmp_path, metres_per_unit=0.5).text
    assert "diameter (scene units)" in unknown
    assert "0.08 ± 0.004" in unknown
    assert "diameter (mm)" in known
    assert "40 ± 2" in known
    assert "33.5" in known  # cm³


@pytest.mark.parametrize("place", ["label", "title", "decision", "notice", "provenance"])
def test_markup_in_any_text_is_shown_and_never_obeyed(place: str, tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    changes: dict = {
        "label": {"fruit_count": count_of(fruit(1, 0.0, label=evil))},
        "title": {"title": evil},
        "decision": {"reviewed": Reviewed(line="one", interval=None, decisions=[evil])},
        "notice": {"provenance": {"notices": [evil]}},
        "provenance": {"provenance": {"source": evil}},
    }[place]
    reader = page(tmp_path, **changes)
    assert "script" not in reader.tags
    assert evil in reader.text


def test_the_page_needs_no_other_file_and_no_network(tmp_path: Path) -> None:
    Image.new("RGB", (50, 20)).save(tmp_path / "view_1.png")
    reader = page(tmp_path, strips=[tmp_path / "view_1.png"])
    assert len(reader.addresses) == 2
    assert all(address.startswith("data:image/jpeg;base64,") for address in reader.addresses)
    assert not {"script", "link", "iframe"} & set(reader.tags)
    assert "url(" not in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_zero_gives_its_reason(tmp_path: Path) -> None:
    settings = {"config": {"count": {"threshold": 0.5}}}
    assert explain_nothing_found(NO_FRUIT, 0.5, None) in page(tmp_path, NO_FRUIT, provenance=settings).text
    assert "highest probability .31 is below .50" in page(tmp_path, NO_FRUIT, still=None).text


def test_what_the_user_decided_stands_next_to_the_count(tmp_path: Path) -> None:
    reviewed = Reviewed(line="3 apples after review", interval=(3, 4), decisions=["rejected 7: a leaf", "added 9"])
    text = page(tmp_path, reviewed=reviewed).text
    assert "3 apples after review (90 % interval 3–4)" in text
    assert text.index("rejected 7: a leaf") < text.index("added 9")
    assert "after review" not in page(tmp_path).text


def test_each_tree_of_a_row_has_its_count(tmp_path: Path) -> None:
    trees = [Tree(1, np.zeros(3), 31, (30, 33), 31.5, 34.0, (31, 39)), Tree(2, np.ones(3), 12)]
    text = " ".join(page(tmp_path, count_of(*TWO.fruits, trees=trees)).text.split())
    assert "13130–3331–39 212--" in text
    assert "By tree" in text
    assert "By tree" not in page(tmp_path).text


def test_how_it_was_made_is_folded(tmp_path: Path) -> None:
    reader = page(
        tmp_path, provenance={"versions": {"numpy": "1.26.4"}, "prompts": ["red apple", "pear"], "seed": None}
    )
    assert "details" in reader.tags
    assert "versions.numpy1.26.4" in reader.text
    assert "red apple, pear" in reader.text


def test_a_list_of_records_is_reported_without_brackets(tmp_path: Path) -> None:
    records = [{"view": "1.jpg", "psnr": 23.1}, {"view": "9.jpg", "psnr": 24.0}]
    assert "view 1.jpg psnr 23.1, view 9.jpg psnr 24.0" in page(tmp_path, provenance={"held_out": records}).text


def test_the_same_count_gives_the_same_page(tmp_path: Path) -> None:
    page(tmp_path)
    first = (tmp_path / "report.html").read_bytes()
    page(tmp_path)
    assert (tmp_path / "report.html").read_bytes() == first


def test_a_strip_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    (tmp_path / "view_1.png").write_text("no picture")
    with pytest.raises(OutputError, match=r"view_1\.png cannot be read"):
        page(tmp_path, strips=[tmp_path / "view_1.png"])


@pytest.mark.parametrize("values", [[78.3], [60.0, 60.0], [0.01, 0.02, 0.5], list(range(1, 900))])
def test_a_histogram_holds_every_value_once_between_round_sides(values: list[float]) -> None:
    bars = histogram(np.array(values, float))
    assert bars.counts.sum() == len(values)
    assert bars.edges[0] <= min(values)
    assert bars.edges[-1] >= max(values)
    assert len(bars.counts) <= 20
    step = bars.edges[1] - bars.edges[0]
    assert round(step / 10 ** np.floor(np.log10(step) + 1e-9), 6) in (1.0, 2.0, 5.0)


def test_the_tallest_bar_is_the_fullest() -> None:
    svg = str(drawing(histogram(np.array([1.0, 5.0, 5.1, 5.2, 9.0])), axis="diameter (mm)"))
    heights = [float(height) for height in re.findall(r'<rect [^>]*height="([\d.]+)"', svg)]
    assert max(heights) == pytest.approx(3 * sorted(heights)[-2], rel=0.01)
    assert "diameter (mm)" in svg


def test_the_template_is_part_of_the_package() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "page.html" in settings["tool"]["setuptools"]["package-data"]["fruitlangs.engine.report"]
    assert any(requirement.startswith("jinja2") for requirement in settings["project"]["dependencies"])


def test_a_zero_without_settings_is_reported_by_the_largest_clusters_alone(tmp_path: Path) -> None:
    many = [AuditEntry(number, "dropped", f"reason {number}", (0.0, 1.0, 2.0), 10 + number) for number in range(50)]
    text = page(tmp_path, dataclasses.replace(NO_FRUIT, audit=many)).text
    assert "reason 49; reason 48; reason 47" in text
    assert "reason 46" not in text


def test_fruit_that_the_user_rejected_all_were_found_nevertheless(tmp_path: Path) -> None:
    found = AuditEntry(0, "kept", "one sphere", (0.0, 1.0, 2.0), 400, (1,))
    text = page(tmp_path, dataclasses.replace(NO_FRUIT, audit=[found])).text
    assert "every counted fruit was rejected" in text
