"""Reports: complete, the same bytes for the same numbers, and safe against names with markup."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from replays.report import Report, Row, check_report, write_report
from replays.report.canvas import new_figure
from rig.base.errors import InputError


def _report() -> Report:
    report = Report("Validation of <b>a & b</b>.mcap", "One of two criteria is met.")
    report.heading("Free run")
    report.text("μ = 0.25")
    report.table(
        ("quantity", "value", "verdict"),
        [Row(("whirl", "83.1 Hz", "agrees"), "good"), ("force", "553 N", "told")],
        caption="At 6.2 Hz",
    )
    figure = new_figure(2.0)
    figure.subplots().plot([0.0, 1.0])
    report.picture(figure, "A line")
    return report


class _Page(HTMLParser):
    """Collects tags and the text of cells, and refuses tags that do not close in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.text: list[str] = []
        self.outside: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.outside += [value for name, value in attrs if name in ("src", "href") and value and "data:" not in value]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data.strip())


def test_html_is_self_contained(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(_report(), path)
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    assert page.outside == []
    assert "script" not in page.tags
    assert "b" not in page.tags, "what stands in a name is text"
    for text in ("Validation of <b>a & b</b>.mcap", "At 6.2 Hz", "83.1 Hz", "told", "A line", "μ = 0.25"):
        assert text in page.text
    assert page.tags.count("img") == 1


def test_numbers_are_right_aligned_and_the_header_has_the_origin(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    report = Report("Fit", "NOT GOOD.", origin={"command": "`rig identify <a>.mcap`", "made": "2026-01-01"}, mark="bad")
    rows = [("a", "1.5", "within ±2", "-", "1"), ("b", "-2e-05 m/s^2", "3", "≤ 0.2 N", "see `rest`")]
    report.table(("name", "value", "words", "limit", "note"), rows, caption="`left` is what remains")
    write_report(report, path)
    page = path.read_text(encoding="utf-8")
    assert report.parts[0].numeric == (False, True, False, True, False)
    assert '<td class="number">-2e-05 m/s²</td>' in page
    assert page.count('class="number"') == 2 * (1 + len(rows))
    assert "<caption><code>left</code> is what remains</caption>" in page
    assert '<td class="verdict">see <code>rest</code></td>' in page
    assert "<dt>command</dt><dd><code>rig identify &lt;a&gt;.mcap</code></dd>" in page
    assert page.index('<p class="lead bad">NOT GOOD.</p>') < page.index("<dt>made</dt><dd>2026-01-01</dd>")
    assert "`" not in page


def test_symbols_are_typeset_and_decimal_points_aligned(tmp_path: Path) -> None:
    report = Report("Fit")
    rows = [("R_{S}", "1.5", "1"), ("shaft.arm_ring", "12", "a word"), ("K", "7·10^{5}", "2.50"), ("e", "−", "3")]
    report.table(("name", "value [N^{2}]", "mixed"), rows)
    write_report(report, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for cell in (
        "<td>R<sub>S</sub></td>", "<td>shaft.arm_ring</td>", "value [N<sup>2</sup>]", '<td class="number">1.5</td>',
        '<td class="number" data-tail=".0">12</td>', '<td class="number">7·10<sup>5</sup></td>',
        '<td class="number">−</td>', '<td class="verdict">1</td>',
    ):  # fmt: skip
        assert cell in page
    write_report(report, tmp_path / "report.pdf")


@pytest.mark.parametrize("name", ["report.html", "report.pdf"])
def test_the_same_report_gives_the_same_bytes(tmp_path: Path, name: str) -> None:
    written = []
    for _ in range(2):
        write_report(_report(), tmp_path / name)
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1]
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_pdf_is_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "report.pdf"
    write_report(_report(), path)
    data = path.read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.rstrip().endswith(b"%%EOF")
    assert b"/Subtype /Image" in data


@pytest.mark.parametrize("suffix", [".html", ".pdf"])
def test_an_undecodable_name_is_shown_escaped(suffix: str, tmp_path: Path) -> None:
    name = "a\udcff\x01\u202e.mcap"  # as the system represents a file name that is not UTF-8
    report = Report(name, name, origin={"file": name})
    report.heading(name)
    report.text(name)
    report.table([name], [[name]], caption=name)
    write_report(report, tmp_path / f"report{suffix}")
    if suffix == ".html":
        assert (tmp_path / "report.html").read_text("utf-8").count("a\\udcff\\x01\\u202e.mcap") == 9


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="row must have 2 cells"):
        Report("x").table(("a", "b"), [("1", "2", "3")])


@pytest.mark.parametrize(
    ("name", "complaint"),
    [("r.txt", "ends in .html or .pdf"), ("none/r.html", "in a folder that exists"), ("old.pdf", "a new file")],
)
def test_invalid_report_paths_are_refused(tmp_path: Path, name: str, complaint: str) -> None:
    (tmp_path / "old.pdf").write_bytes(b"")
    with pytest.raises(InputError, match=complaint):
        check_report(tmp_path / name, force=False)


def test_an_existing_report_is_replaced_when_asked(tmp_path: Path) -> None:
    (tmp_path / "old.pdf").write_bytes(b"old")
    check_report(tmp_path / "old.pdf", force=True)
    assert (tmp_path / "old.pdf").read_bytes() == b"old", "only once there is a new one"
    write_report(Report("New"), tmp_path / "old.pdf")
    assert (tmp_path / "old.pdf").read_bytes().startswith(b"%PDF")


def test_tables_of_any_width_go_into_a_pdf(tmp_path: Path) -> None:
    """Columns that just fill a page must not exceed it by a rounding error."""
    report = Report("Tables", "")
    for columns in range(1, 12):
        for length in range(1, 60, 7):
            cells = [f"{'word ' * (length // (1 + n))}{n}" for n in range(columns)]
            report.table(cells, [cells])
    write_report(report, tmp_path / "tables.pdf")
    assert (tmp_path / "tables.pdf").read_bytes().startswith(b"%PDF")


def test_a_long_report_begins_with_its_contents(tmp_path: Path) -> None:
    report = Report("Long")
    for number in range(3):
        report.heading(f"Part {number} & more")
        report.heading("The same", level=2)
        report.text("Something.")
    write_report(report, tmp_path / "long.html")
    page = (tmp_path / "long.html").read_text()
    contents = page[page.index("<nav>") : page.index("</nav>")]
    targets = re.findall(r'href="#([^"]+)">([^<]+)<', contents)
    assert [text for _, text in targets] == [
        text for number in range(3) for text in (f"Part {number} &amp; more", "The same")
    ]
    below = page[page.index("</nav>") :]
    for target, text in targets:
        assert re.search(rf'<h[23] id="{target}">{text}<', below), "each link leads to its own heading"
    assert len({target for target, _ in targets}) == len(targets)
    short = Report("Short")
    short.heading("Alone")
    write_report(short, tmp_path / "short.html")
    assert "<nav>" not in (tmp_path / "short.html").read_text()


def test_markdown_has_text_tables_and_captions(tmp_path: Path) -> None:
    report = _report()
    report.table(("a|b", "c"), [("1", "2|3")])
    write_report(report, tmp_path / "report.md")
    blocks = (tmp_path / "report.md").read_text(encoding="utf-8").split("\n\n")
    assert blocks[:5] == [
        "# Validation of <b>a & b</b>.mcap", "One of two criteria is met.", "## Free run", "μ = 0.25", "At 6.2 Hz",
    ]  # fmt: skip
    assert blocks[5].splitlines()[1:3] == ["| --- | --- | --- |", "| whirl | 83.1 Hz | agrees |"]
    assert blocks[6:] == ["A line", "| a\\|b | c |\n| --- | --- |\n| 1 | 2\\|3 |\n"]
