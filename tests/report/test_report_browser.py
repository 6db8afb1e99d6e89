"""The report in a real browser: every picture decodes, nothing is fetched, nothing overflows."""

import html
import json
import re
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from ntop.config.sections import EvaluateConfig
from ntop.stages import s8_evaluate

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--hide-scrollbars", "--enable-logging=stderr",
)  # fmt: skip
# the page itself has no script; this one only looks, and leaves what it saw in the document
PROBE = """<script>
const errors = [];
addEventListener("error", e => errors.push(e.message || e.target.tagName), true);
addEventListener("load", () => {
  const images = [...document.images];
  const canvas = document.createElement("canvas").getContext("2d");
  for (const image of images) {  // drawing decodes at once: --dump-dom waits for no promise
    try { canvas.drawImage(image, 0, 0); } catch (e) { errors.push(String(e)); }
  }
  const visible = s => [...document.querySelectorAll(s)]
    .filter(e => getComputedStyle(e).display !== "none").length;
  const seen = {
    errors, images: images.length, empty: images.filter(i => !i.naturalWidth).length,
    unnamed: images.filter(i => !i.alt).length,
    fetched: performance.getEntriesByType("resource").map(e => e.name.slice(0, 40))
      .filter(n => !n.startsWith("data:")),
    overflow: document.documentElement.scrollWidth - innerWidth,
    coco17: visible(".sheet svg.coco17"), smpl24: visible(".sheet svg.smpl24"),
  };
  document.querySelectorAll("input[value=smpl24]").forEach(i => i.click());
  seen.smpl24_chosen = visible(".sheet svg.smpl24");
  seen.coco17_hidden = visible(".sheet svg.coco17") === 0;
  const out = document.createElement("pre");
  out.id = "probe"; out.textContent = JSON.stringify(seen);
  document.body.append(out);
});
</script></head>"""

pytestmark = pytest.mark.skipif(
    BROWSER is None, reason="no chromium on PATH; on Debian: apt-get install chromium"
)


def browse(page, *, profile, flags):
    return subprocess.run(
        [BROWSER, *FLAGS, f"--user-data-dir={profile}", *flags, page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )


def probed(answer):
    found = re.search(r'<pre id="probe">(.*?)</pre>', answer.stdout, re.DOTALL)
    assert found, answer.stderr[-2000:]
    return json.loads(html.unescape(found.group(1)))


@pytest.fixture(scope="module")
def report(world, tmp_path_factory):
    out = tmp_path_factory.mktemp("browser") / "tiny"
    s8_evaluate.main(
        EvaluateConfig(provides={a.source: ("masks", "bodies") for a in world.actors}),
        dataset=world.dataset,
        actors=world.actors_table(),
        captures=world.root / "1_capture",
        masks=world.root / "2_mask",
        fits=world.root / "3_fit",
        avatars=world.root / "4_train",
        benchmarks=world.benchmarks,
        out=out,
    )
    return out / "report.html"


@pytest.mark.parametrize("width", [1280, 500])
def test_the_browser_shows_everything_without_help(report, tmp_path, width):
    page = tmp_path / "probed.html"
    page.write_text(report.read_text().replace("</head>", PROBE, 1))
    flags = ("--dump-dom", f"--window-size={width},900")
    answer = browse(page, profile=tmp_path / "profile", flags=flags)
    seen = probed(answer)
    assert seen["images"] == 2 * 6 + 2 * (9 + 4) + 3 * 4 + 4
    assert seen["errors"] == [] and seen["fetched"] == []
    assert seen["empty"] == seen["unnamed"] == 0
    assert seen["overflow"] <= 0
    assert (seen["coco17"], seen["smpl24"]) == (2 * 9, 0)
    assert seen["smpl24_chosen"] == 2 * 9 and seen["coco17_hidden"]
    assert "CONSOLE" not in answer.stderr, answer.stderr[-2000:]


def test_a_broken_picture_would_be_noticed(report, tmp_path):
    page = tmp_path / "broken.html"
    text = report.read_text().replace("</head>", PROBE, 1)
    page.write_text(text.replace("data:image/webp;base64,UklGR", "data:image/webp;base64,XXXXX", 1))
    seen = probed(browse(page, profile=tmp_path / "profile", flags=("--dump-dom",)))
    assert seen["empty"] == 1
    assert len(seen["errors"]) == 2  # the element's own event, and drawing it


@pytest.mark.parametrize("dark", [False, True])
def test_a_screenshot_is_no_blank_page(report, tmp_path, dark):
    path = tmp_path / "shot.png"
    flags = [f"--screenshot={path}", "--window-size=1280,2000"]
    if dark:
        flags.append("--blink-settings=preferredColorScheme=0")
    browse(report, profile=tmp_path / "profile", flags=flags)
    shot = cv2.imread(str(path))
    assert shot.shape == (2000, 1280, 3)
    background = shot[2, 2].astype(int)
    assert (background.mean() < 60) == dark
    different = np.abs(shot.astype(int) - background).max(-1) > 40
    assert 0.03 < different.mean() < 0.7
