"""The report page: complete, self-contained, escaped; and looked at by a real browser where there is one."""

import base64
import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

pytest.importorskip("matplotlib", reason="needs the extra: pip install 'dnerf[report]'")

from dnerf.evaluation.plots import frame_curves
from dnerf.evaluation.report import data_uri, read_scores, write_report_text
from dnerf.visualization.video import write_frames, write_png

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")

METRICS = {
    "split": "test", "psnr": 27.05, "ssim": 0.9539, "num_frames": 3, "seconds_per_frame": 0.15, "train_seconds": 45.2,
    "num_steps": 710, "num_parameters": 2441111, "seed": 3, "train_hardware": "2 x A", "train_commit": "abc",
    "resolution": 200, "background": "white", "scene": "walker", "method": "Displacement + Grid", "protocol": "dnerf",
    "hardware": "2 x <B>", "commit": "def-dirty", "version": "0.1.0", "torch": "2",
    "frames": [{"index": i, "time": i / 2, "psnr": 26.0 + i, "ssim": 0.9} for i in (2, 0, 1)],
}  # fmt: skip
TEMPORAL = {
    "motion": "exact", "num_frames": 9, "time_step": 0.125, "resolution": 64, "warping_error": 0.00451,
    "true_warping_error": 0.00292, "flicker": 0.06, "true_flicker": 0.12, "found": 0.949, "track_error": 0.0439,
    "flow_error": None, "true_flow_error": 0.0311, "still_flow_error": 1.234, "depth_consistency": None,
}  # fmt: skip


def page(folder: Path, **changes: object) -> str:
    frames = [torch.rand(33, 40, 3) for _ in range(6)]
    given = {
        "title": "A <b>walker</b> & friends",
        "metrics": [METRICS, {**METRICS, "protocol": "gs", "split": "val", "psnr": 30.125}],
        "config": "seed: 3 # </pre><script>alert(1)</script>",
        "films": [write_frames(frames, folder / name, fps=10) for name in ("orbit_depth.mp4", "a.gif")],
        "sheets": [("Worst frames", "lowest first", write_png(frames[0], folder / "worst.png"))],
        "temporal": TEMPORAL,
    }  # fmt: skip
    return write_report_text(**{**given, **changes})


class Page(HTMLParser):
    """Collects tags, addresses and visible text."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attributes if name in ("src", "href", "data", "poster")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_page_holds_every_number_escaped_and_nothing_from_elsewhere(tmp_path: Path) -> None:
    text = page(tmp_path, plan=[("part", "choice"), ("motion", "still <b>")])
    assert "still &lt;b&gt;" in text
    parsed = Page()
    parsed.feed(text)
    shown = [address for address in parsed.addresses if not address.startswith("#")]  # SVG refers to its own parts
    assert len(shown) == 3
    assert all(address.startswith("data:") for address in shown)
    assert not re.search(r"url\((?!#)|@import", text)
    assert "script" not in parsed.tags
    assert "link" not in parsed.tags
    for value in ("27.05 dB", "0.9539", "30.12", "2,441,111", "abc", "def-dirty", "2 x <B>", "on white", "0.00451",
                  "0.00292", "protocol dnerf", "protocol gs", "walker", "45 s", "26.00", "28.00"):  # fmt: skip
        assert value in parsed.text, value
    assert parsed.text.index("26.00") < parsed.text.index("alert(1)")
    assert "<b>walker</b>" not in text
    assert "A &lt;b&gt;walker&lt;/b&gt; &amp; friends" in text
    assert "<script>" not in text


def test_page_without_films_images_and_time_is_a_page_too(tmp_path: Path) -> None:
    text = page(tmp_path, films=[], sheets=[], temporal=None)
    for heading in ("Films", "Over time", "Worst frames", "found to need"):
        assert heading not in text
    assert "All scores" in text


def test_model_motion_is_said_to_be_its_own_and_what_was_not_measured(tmp_path: Path) -> None:
    text = page(tmp_path, temporal={**TEMPORAL, "motion": "model"})
    assert "true motion is not known" in text
    assert "true motion is not known" not in page(tmp_path)
    text = page(tmp_path)
    assert text.count("not measured") == 2
    assert re.search(r"<td>flow error</td><td[^>]*>not measured</td><td[^>]*>0.031</td><td[^>]*>1.234</td>", text)


def test_data_uris_hold_the_bytes(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(bytes(range(256)))
    kind, _, encoded = data_uri(path).partition(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(encoded) == bytes(range(256))


def test_what_cannot_be_shown_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"a.txt: expected one of .mp4, .gif, .png"):
        data_uri(tmp_path / "a.txt")
    with pytest.raises(ValueError, match="metrics must hold the scores of at least one evaluation"):
        page(tmp_path, metrics=[])
    monkeypatch.setattr("dnerf.evaluation.report.MAX_BYTES", 1000)
    with pytest.raises(ValueError, match="films and images must be at most"):
        page(tmp_path)


def test_scores_are_read_and_broken_ones_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no metrics.json; score the run first"):
        read_scores(tmp_path)
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS))
    (tmp_path / "metrics_gs_test.json").write_text(json.dumps({**METRICS, "protocol": "gs"}))
    assert [scores["protocol"] for scores in read_scores(tmp_path)] == ["gs", "dnerf"]
    for broken in ("{", "[]", "{}", '{"frames": 3, "split": "test"}'):
        (tmp_path / "metrics.json").write_text(broken)
        with pytest.raises(ValueError, match=r"metrics.json: not a file of scores"):
            read_scores(tmp_path)


def test_curves_go_through_the_scores_in_order_of_time() -> None:
    svg = frame_curves({"walker": METRICS["frames"]})
    assert svg.startswith("<svg")
    assert svg == frame_curves({"walker": METRICS["frames"]})
    # The line of three points: evenly spaced to the right, PSNR 26, 27, 28 evenly upwards (smaller y).
    lines = re.findall(r'd="M ([\d.]+) ([\d.]+) \nL ([\d.]+) ([\d.]+) \nL ([\d.]+) ([\d.]+) \n"', svg)
    assert len(lines) == 1
    x0, y0, x1, y1, x2, y2 = map(float, lines[0])
    assert x0 < x1 < x2
    assert x1 - x0 == pytest.approx(x2 - x1, rel=1e-3)
    assert y0 - y1 == pytest.approx(y1 - y2, rel=1e-3)
    assert y0 > y1
    with pytest.raises(ValueError, match="walker must have frames with psnr"):
        frame_curves({"walker": [{"time": 0.5}]})


PROBE = """<script>
addEventListener("load", () => setTimeout(function look(tries = 0) {
  const page = document.querySelector("iframe").contentDocument, root = page.documentElement;
  const video = page.querySelector("video"), width = element => element.getBoundingClientRect().width;
  if (video.readyState < 2 && tries < 400) {
    // The page's clock is virtual and runs ahead while the film is decoded: work takes real time.
    for (let i = 0, sum = 0; i < 1e6; i++) sum += Math.sin(i);
    return setTimeout(look, 100, tries + 1);
  }
  const luminance = color => color.match(/[0-9.]+/g).slice(0, 3).reduce((sum, part) => sum + part / 765, 0);
  const style = getComputedStyle(page.body);
  const found = {
    images: [...page.images].map(image => [image.complete, image.naturalWidth, image.naturalHeight]),
    video: [video.readyState, video.videoWidth, video.videoHeight, video.error === null],
    requests: [performance, page.defaultView.performance].flatMap(all => all.getEntriesByType("resource"))
      .map(entry => entry.name).filter(name => !name.startsWith("data:") && !name.startsWith("about:")),
    curves: [...page.querySelectorAll(".curve svg")].map(width),
    curveText: Math.min(...[...page.querySelectorAll(".curve svg [id^=text_]")]
      .map(text => text.getBoundingClientRect()).map(box => Math.min(box.width, box.height))),
    overflow: root.scrollWidth - root.clientWidth,
    wider: [...page.querySelectorAll("section > *, .card, figure > *")].map(width)
      .filter(found => found > root.clientWidth).length,
    brokenCards: [...page.querySelectorAll(".card b")].filter(card => card.scrollWidth > card.clientWidth).length,
    paper: luminance(style.backgroundColor), ink: luminance(style.color),
    heading: page.querySelector("h1").innerText,
    caption: page.querySelector("figcaption").innerText,
  };
  document.body.setAttribute("data-found", JSON.stringify(found));
}, 500));
</script>"""
"""Looks into a page of the same origin in a frame: windows cannot be made as narrow as a telephone, frames can."""


@pytest.mark.parametrize(("width", "dark"), [(1100, False), (360, False), (360, True)])
def test_a_real_browser_shows_everything(tmp_path: Path, width: int, dark: bool) -> None:
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"no browser found: none of {', '.join(BROWSERS)} is on the PATH")
    frame = f'<iframe width="{width}" height="900" srcdoc="{html.escape(page(tmp_path))}"></iframe>'
    path = tmp_path / "probed.html"
    path.write_text(f'<!doctype html><meta charset="utf-8"><body>{frame}{PROBE}</body>', encoding="utf-8")
    done = subprocess.run(
        [browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync",
         f"--blink-settings=preferredColorScheme={0 if dark else 1}",
         f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1200,1000", "--virtual-time-budget=60000",
         "--dump-dom", path.as_uri()],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    match = re.search(r'data-found="([^"]*)"', done.stdout)
    assert match is not None, done.stdout[-2000:]
    found = json.loads(html.unescape(match[1]))
    assert found["images"] == [[True, 40, 33], [True, 40, 33]]
    assert found["video"][0] >= 2, "the video has no image"
    assert found["video"][1:] == [40, 34, True]
    assert found["requests"] == []
    assert len(found["curves"]) == 2
    assert min(found["curves"]) > 0.7 * min(width, 900)
    # Digits are 0.72 of their font's size high: 10 pixels at least.
    assert found["curveText"] >= 7.2, "the curves' labels are too small to be read"
    assert found["overflow"] <= 0
    assert found["wider"] == 0
    assert found["brokenCards"] == 0
    assert (found["paper"] < 0.2 and found["ink"] > 0.8) if dark else (found["paper"] > 0.9 and found["ink"] < 0.2)
    assert found["heading"] == "A <b>walker</b> & friends"
    assert found["caption"] == "orbit depth: expected distance along the ray (not z-depth), in world units"


def test_wide_films_get_the_whole_width_one_frame_no_curve_and_evaluations_a_column(tmp_path: Path) -> None:
    frames = [torch.rand(32, 96, 3) for _ in range(3)]
    film = write_frames(frames, tmp_path / "test.mp4", fps=10)
    assert '<figure class="wide">' in page(tmp_path, films=[film])
    assert '<figure class="wide">' not in page(tmp_path)
    one = {**METRICS, "frames": METRICS["frames"][:1], "num_frames": 1, "frames_of_split": 20}
    text = page(tmp_path, metrics=[one])
    assert "PSNR over time" not in text
    assert "Means over 1 of the 20 frames of the test split" in text
    text = page(tmp_path)
    assert re.search(r'<th class="key" scope="row">PSNR</th><td>27.05</td><td>30.12</td></tr>', text)
