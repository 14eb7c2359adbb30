"""The page of a run and of a patient, from made-up results; and in a real browser, without a network."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv

import lacli
from lacli.api.study import _thickness
from lacli.base.errors import InputError, UsageError
from lacli.contracts.identity import run_key
from lacli.contracts.labels import BODY_REGIONS, PLANES, REGIONS, RINGS
from lacli.contracts.scene import load_scene
from lacli.report.page.document import Page, Section, html
from lacli.report.page.patient import patient_page
from lacli.report.page.run import read_run, run_page
from lacli.report.page.shape import NAMES, OtherAnatomyError, atrium

SCENE = """
[anatomy]
bundle = "nowhere"
[materials.alpha]
anterior = 1.0
posterior = 2.0
septum = 1.0
lateral = 1.0
roof = 4.0
"""


def _shell() -> pv.UnstructuredGrid:
    """A spherical shell of wedges, 25 mm in radius: five regions, a ring and a plane below."""
    ball = pv.Icosphere(radius=1.0, nsub=2)
    triangles = ball.faces.reshape(-1, 4)[:, 1:]
    points = np.vstack([25 * ball.points, 27 * ball.points]).astype(float)
    cells = np.hstack([np.full((len(triangles), 1), 6), triangles, triangles + ball.n_points]).ravel()
    grid = pv.UnstructuredGrid(cells, np.full(len(triangles), pv.CellType.WEDGE), points)
    x, y, z = ball.points[triangles].mean(axis=1).T
    side = np.where(np.abs(y) >= np.abs(x), np.where(y < 0, 1, 2), np.where(x < 0, 3, 4))
    region = np.select([z > 0.6, z < -0.85, z < -0.7], [REGIONS["roof"], PLANES["mv"], RINGS["mv"]], side)
    grid.cell_data["region"] = region
    return grid


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "runs" / "k1"
    (folder / "fields").mkdir(parents=True)
    es = _shell()
    es.point_data["displacement"] = 0.1 * np.asarray(es.points)  # a tenth of the radius: 2.5 mm inside, 2.7 outside
    es.points = 1.1 * np.asarray(es.points)
    es.point_data["displacement"] = np.asarray(es.points) / 11
    es.save(folder / "fields" / "es.vtu")
    (folder / "scene.toml").write_text(SCENE)
    manifest = {"key": "k1", "status": "done", "versions": {"lacli": "9.9.9", "freefem": "4.9"}, "cpu_s": 12.5, "wall_s": 20.0}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    features = {"edv_ml": 99.8, "esv_ml": 134.8, "d_global_mm": 4.6, "min_jacobian": 0.85, "es_unstable_modes": 2}
    features["unstable_frames"] = {"0.2": 3}
    (folder / "features.json").write_text(json.dumps(features | {f"d_{name}_mm": 5.0 for name in BODY_REGIONS}))
    times = "\n".join(f"{t},{'ed' if t == 0 else 'reservoir'},{6 + 10 * t},{100 + 50 * t},{9 * t}" for t in (0.0, 0.2, 0.4))
    (folder / "transients.csv").write_text(f"time,phase,pressure_mmhg,volume_ml,d_global_mm\n{times}\n")
    return folder


@pytest.fixture
def patient(tmp_path: Path) -> Path:
    folder = tmp_path / "patient"
    folder.mkdir()
    wave = {
        "wave": 1,
        "runs": 16,
        "failed": 1,
        "threshold": 3.5,
        "r2": {"esv_ml": 0.99},
        "share": 0.65,
        "change": None,
        "notes": [],
    }
    row = {"input": "alpha_roof", "map": 2.0, "mean": 2.2, "sd": 0.4, "low95": 1.6, "high95": 3.0, "rhat": 1.0, "ess": 3000.0}
    fit = {"feature": "esv_ml", "target": 160.2, "sd": 5.0, "emulated": 160.1, "simulated": 160.0}
    verdict = {"plausible": True, "warnings": ["<b>alpha_roof</b> is at the end of its range"]}
    document = {"stopped": "one wave was allowed", "waves": [wave], "posterior": [row], "fit": [fit], "verdict": verdict}
    document |= {"converged": False, "samples": 2880, "acceptance": 0.3, "rmse_mm": 0.5}
    (folder / "result.json").write_text(json.dumps(document))
    (folder / "runs.csv").write_text("alpha_roof,esv_ml,status,cpu_s\n1,150,done,3600\n2,160,done,3600\n3,,failed,3600\n")
    return folder


class _Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.add(value or "")
            if name in ("href", "src", "srcset", "action", "data"):
                self.links.append((tag, value or ""))


def _check_links(text: str) -> None:
    found = _Links()
    found.feed(text)
    assert any(tag == "img" for tag, _ in found.links)
    for tag, link in found.links:
        assert link[1:] in found.ids if link.startswith("#") else link.startswith("data:"), (tag, link[:80])
    assert not re.search(r"url\(|@import|import\(|fetch\(|XMLHttpRequest", text)


def test_the_page_of_a_run(run: Path, tmp_path: Path) -> None:
    made = lacli.write_report(run, tmp_path / "run.html")
    text = made.page.read_text(encoding="utf-8")
    assert made.kind == "run" and made.size == len(text.encode()) < 15_000_000
    _check_links(text)
    assert {f.suffix for f in made.figures.iterdir()} == {".png", ".pdf", ".svg"}
    for words in (
        "134.8",
        "no stable equilibrium: 2 ways",
        "3 at 0.2 RR",
        "No discretisation error is known",
        "Wall thickness is not shown",
        "FreeFEM 4.9",
    ):
        assert words in text, words
    for key in ("Hecht2012", "Guccione1991", "Roney2019"):
        assert f"@article{{{key}," in text
    assert "version = {9.9.9}" in text


def test_the_page_of_a_patient(run: Path, patient: Path, tmp_path: Path) -> None:
    made = lacli.write_report(patient, tmp_path / "p.html", run=run)
    text = made.page.read_text(encoding="utf-8")
    assert made.kind == "patient"
    _check_links(text)
    assert "<b>alpha_roof</b>" not in text and "&lt;b&gt;alpha_roof&lt;/b&gt; is at the end of its range" in text
    # the run's alpha of the roof is 4, the most probable 2
    assert "not made at the most probable parameters: alpha_roof 4 (most probable 2)" in text
    assert "The sampler did not converge" in text
    assert re.search(r"CPU time of all runs, h</td><td>3<", text)
    assert "@article{ForemanMackey2013," in text
    assert "window.viewer" not in html(patient_page(patient, tmp_path, None, None))


def test_nothing_of_another_bundle_stands_beside_a_run(run: Path, tmp_path: Path) -> None:
    """The bundle meshed anew, thicker, under the same name: its thickness and its cells' errors are not the run's."""
    lacli.synthesize(tmp_path / "la", cell_size_mm=12.0, order=1)
    (run / "scene.toml").write_text(SCENE.replace("nowhere", str(tmp_path / "la")))
    manifest = json.loads((run / "manifest.json").read_text()) | {"key": run_key(load_scene(run / "scene.toml"))}
    (run / "manifest.json").write_text(json.dumps(manifest))
    assert read_run(run).features["discretisation_error"] and not read_run(run).changed
    thickness, note = _thickness(run)
    assert thickness is not None and thickness[1].mean() == pytest.approx(2.0, abs=0.2) and not note
    shutil.rmtree(tmp_path / "la")
    lacli.synthesize(tmp_path / "la", cell_size_mm=12.0, order=1, thickness_mm=3.0)
    text = lacli.write_report(run, tmp_path / "run.html").page.read_text(encoding="utf-8")
    for words in (
        "No discretisation error is shown: scene.toml, the bundle",
        "Wall thickness is not shown: scene.toml, the bundle",
    ):
        assert words in text
    assert "discretisation_error" not in read_run(run).features


def test_a_run_of_another_anatomy_is_refused(run: Path, patient: Path, tmp_path: Path) -> None:
    bundle = run.parent / "la"
    bundle.mkdir()
    for name in ("wall.vtu", "boundary.vtp"):
        (bundle / name).write_bytes(b"other")
    (run / "scene.toml").write_text(SCENE.replace("nowhere", str(bundle)))
    (patient / "calibration.json").write_text(json.dumps({"content": {"runs.bundle": "content 0123456789abcdef"}}))
    with pytest.raises(InputError, match="is not the calibration's"):
        lacli.write_report(patient, tmp_path / "p.html", run=run)
    assert not (tmp_path / "p.html").exists()


def test_no_page_of_what_has_no_result(run: Path, patient: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="neither a run"):
        lacli.write_report(tmp_path, tmp_path / "x.html")
    with pytest.raises(UsageError, match=r"an \.html file"):
        lacli.write_report(run, tmp_path / "x.pdf")
    with pytest.raises(UsageError, match="goes with a patient"):
        lacli.write_report(run, tmp_path / "x.html", run=run)
    (run / "manifest.json").write_text(json.dumps({"status": "failed", "message": "inverted"}))
    with pytest.raises(InputError, match=r"no result \(inverted\)"):
        lacli.write_report(run, tmp_path / "x.html")
    (patient / "result.json").write_text("{}")
    with pytest.raises(InputError, match="posterior, fit"):
        lacli.write_report(patient, tmp_path / "x.html")
    (patient / "result.json").write_text("[1")
    with pytest.raises(InputError, match="not valid JSON"):
        lacli.write_report(patient, tmp_path / "x.html")


def test_the_viewer_s_data(run: Path) -> None:
    es = run / "fields" / "es.vtu"
    ball = np.asarray(pv.Icosphere(radius=25.0, nsub=2).points)
    view = atrium(es, (ball, np.full(len(ball), 2.0)), {"alpha": ("", {"roof": 4.0, "septum": 1.0})})
    assert view is not None
    by_title = {f["title"]: f for f in view["fields"]}
    u = by_title["displacement from ED to ES"]
    assert (u["low"], u["high"]) == pytest.approx((2.5, 2.7), rel=1e-5)
    assert set(by_title["wall thickness"]["means"]) == set(BODY_REGIONS)
    assert by_title["wall thickness"]["means"]["roof"] == pytest.approx(2.0)
    assert by_title["alpha"]["means"] == pytest.approx({"roof": 4.0, "septum": 1.0})
    turn = np.array(view["view"]).reshape(3, 3)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1)  # no mirror image
    with pytest.raises(OtherAnatomyError, match="mm apart"):
        atrium(es, (ball + 9, np.full(len(ball), 2.0)), {})
    es.write_bytes(es.read_bytes()[:200])
    with pytest.raises(InputError, match="cannot be read"):
        atrium(es, None, {})


def test_what_is_text_stays_text() -> None:
    nasty = "</script><script>alert(1)</script>"
    view = {"fields": [{"title": nasty}], "regions": ["", nasty]}
    text = html(Page(nasty, nasty, (Section("a", nasty, (nasty,), (nasty,), view, verbatim=(nasty,)),)))
    assert "<script>alert" not in text
    assert text.count("</script>") == 2  # of the data and of the viewer


# --- in a browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium that draws WebGL by software."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("needs Debian's chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    size, software = "--window-size=1100,1400", ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", size, *software):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    opened = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    opened.set_page_load_timeout(120)
    opened.set_network_conditions(offline=True, latency=0, throughput=0)
    yield opened
    opened.quit()


_SHARE = """const a = viewer.pixels(), of = {}; let drawn = 0;
for (let i = 0; i < a.length; i += 4) if (Math.min(a[i], a[i + 1], a[i + 2]) < 250) drawn++;
return drawn / (a.length / 4);"""


def test_a_browser_draws_it_and_has_nothing_to_say(browser: Any, run: Path, patient: Path, tmp_path: Path) -> None:
    made = lacli.write_report(patient, tmp_path / "p.html", run=run)
    browser.get(made.page.as_uri())
    assert [line["message"] for line in browser.get_log("browser")] == []
    broken = "return [...document.images].filter(i => !i.complete || i.naturalWidth === 0).length"
    assert browser.execute_script(broken) == 0
    assert browser.execute_script("return document.images.length") >= 1
    assert (
        browser.execute_script("return performance.getEntriesByType('resource').filter(e => !e.name.startsWith('data:')).length")
        == 0
    )
    # a ball of 27 mm in a view whose half height is its bounding box's half diagonal / .95: a circle of known area
    radius = 400 * 0.95 / np.sqrt(3)
    assert browser.execute_script(_SHARE) == pytest.approx(np.pi * radius**2 / (1200 * 800), rel=0.05)
    titles = browser.execute_script("return [...document.querySelectorAll('select.field option')].map(o => o.textContent)")
    assert titles[:2] == ["region", "displacement from ED to ES"] and "stiffness alpha, posterior mean" in titles
    region = NAMES.index("roof")
    browser.execute_script(f"viewer.choose({titles.index('stiffness alpha, posterior mean')}); viewer.pick({region})")
    assert (
        browser.execute_script("return document.querySelector('.told').textContent") == "roof: 2.20  (mean over the points drawn)"
    )
    before = browser.execute_script("return Array.from(viewer.pixels().filter((v, i) => i % 401 === 0))")
    browser.execute_script("viewer.turned(0.8, 0.3)")
    assert browser.execute_script("return Array.from(viewer.pixels().filter((v, i) => i % 401 === 0))") != before
    # grown by a tenth, it covers the square of that more
    browser.execute_script("viewer.state.load = 1; viewer.pick(0)")
    assert browser.execute_script(_SHARE) == pytest.approx(1.21 * np.pi * radius**2 / (1200 * 800), rel=0.05)
    assert browser.print_page()[:5] == "JVBER"  # a PDF, in base 64
    assert [line["message"] for line in browser.get_log("browser")] == []


def test_a_click_picks_the_region_in_front(browser: Any, run: Path, tmp_path: Path) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    browser.get(lacli.write_report(run, tmp_path / "r.html").page.as_uri())
    ActionChains(browser).move_to_element(browser.find_element(By.TAG_NAME, "canvas")).click().perform()
    # the first view has anterior in front
    assert browser.execute_script("return document.querySelector('select.region').selectedOptions[0].textContent") == "anterior"


def test_a_page_needs_no_fields(run: Path, tmp_path: Path) -> None:
    (run / "fields" / "es.vtu").unlink()
    text = html(run_page(run, tmp_path / "pictures", None))
    assert "kept no fields" in text and "<canvas" not in text
