"""The report: a page that stands alone and says what the results say, its figures and its pictures."""

import base64
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from room_datasets import write_nerfstudio

from gsfeatloc_ros.evaluate.metrics import QueryResult
from gsfeatloc_ros.evaluate.pictures import mark_matches, side_by_side
from gsfeatloc_ros.evaluate.protocol import SWEEPS
from gsfeatloc_ros.evaluate.report import figures
from gsfeatloc_ros.evaluate.report.page import write_report
from gsfeatloc_ros.evaluate.report.paper import TABLES, published_table
from gsfeatloc_ros.evaluate.run import Run, Task, draw_priors, localize
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.evaluate.tables import Group, RunResults, over_seeds
from gsfeatloc_ros.evaluate.trust import trust_rows, trust_table
from gsfeatloc_ros.match import Matches
from gsfeatloc_ros.simulate import simulate_photos
from gsfeatloc_ros.tools.evaluate import main


class Page(HTMLParser):
    """What a page consists of."""

    def __init__(self, text):
        super().__init__()
        self.text = ""
        self.tags, self.addresses, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.open.append(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "xlink:href", "data")]

    def handle_endtag(self, tag):
        if tag in self.open:
            while self.open.pop() != tag:
                pass

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data


# The page of a real evaluation


@pytest.fixture(scope="module")
def page(tmp_path_factory, room, room_camera, room_map_file):
    """The page of a scene that has the name of one of the paper's: of a photo and of a black one, without an answer."""
    folder = tmp_path_factory.mktemp("page") / "bonsai"
    folder.mkdir()
    camera = room_camera.scaled(320, 240)
    photos = simulate_photos(room, camera, count=2, seed=5)
    black = replace(photos[1], image=np.zeros_like(photos[1].image))
    write_nerfstudio(folder, camera, [photos[0], black], room_map_file)
    kinds = [("paper", "default", 0), ("paper", "default", 1), ("paper", "published", 0), ("paper", "published", 1)]
    kinds += [("chen", "default", 0), ("sweep-rotation", "default", 0), ("sweep-translation", "default", 0)]
    runs = []
    for protocol, method, seed in kinds:
        options = (("max_views", 0),) if method == "default" else ()
        run = Run(folder, None, protocol, None, method, "sift", 1.0, seed, 640, options)
        scene = load_scene(folder)
        tasks = [Task(run, "", scene.photos[prior.photo].name, prior) for prior in draw_priors(run, scene)]
        if protocol in SWEEPS:
            tasks = tasks[::5]
        runs.append(RunResults(run, tasks, [localize(task) for task in tasks]))
    return write_report(folder, runs, "evaluate <bonsai>").read_text(encoding="utf-8")


@pytest.mark.slow
def test_page_needs_nothing_else(page):
    parsed = Page(page)
    assert parsed.open == []
    assert not {"link", "script", "iframe"} & set(parsed.tags)
    for address in parsed.addresses:
        assert address.startswith(("#", "data:image/jpeg;base64,")), address
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)
    anchors = set(re.findall(r'id="([^"]+)"', page))
    assert {address[1:] for address in parsed.addresses if address.startswith("#")} <= anchors


@pytest.mark.slow
def test_page_has_all_cases_with_their_figures(page):
    text = Page(page).text
    for protocol in ("paper", "chen", "sweep-rotation", "sweep-translation"):
        assert f"bonsai, protocol {protocol}, sigma 1" in text
    # Errors, calibration and times of two cases, and two curves.
    assert page.count("<svg") == 2 * 3 + 2
    assert "evaluate <bonsai>" in text
    assert "best of each photo's priors" in text
    assert "default sift max_views=0" in text
    assert "seeds 0,1" in text
    assert not re.search(r"\bnan\b", text, re.IGNORECASE)


@pytest.mark.slow
def test_page_cites_the_published_figures_of_the_data_set(page):
    text = Page(page).text
    assert "over all 9 scenes of Mip-NeRF360" in text
    for figure in ("GSFeatLoc, SuperPoint and SuperGlue", "90.65 %", "1.63°", "iComMa", "arXiv 2504.20379"):
        assert figure in text
    # They are of the paper's own protocol.
    assert text.count("over all 9 scenes") == 1


@pytest.mark.slow
def test_worst_queries_are_shown_with_the_reason(page):
    text = " ".join(Page(page).text.split())
    assert "not answered 1.png (default sift, " in text
    assert "Failed: 0 corners in 0% of the photo" in text
    assert re.search(
        r"Prior off by [\d.]+° and [\d.]+ radii, from where \d+ % of what the photo shows is in view", text
    )
    pictures = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    assert len(pictures) == 6
    for picture in pictures:
        image = cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
        # The photos are 320 pixels wide; they are localized enlarged, and shown as wide as pictures may be.
        assert image.shape == (315, 3 * 420 + 12, 3)
    # Of the black photo: on the left.
    assert image[:, :410].max() < 20
    assert image[:, 440:840].mean() > 40


@pytest.mark.slow
def test_command_writes_the_report_and_goes_on_from_it(tmp_path, room, room_camera, room_map_file, capsys):
    folder = tmp_path / "<b>&amp; room"
    folder.mkdir()
    camera = room_camera.scaled(320, 240)
    write_nerfstudio(folder, camera, simulate_photos(room, camera, count=1, seed=5), room_map_file)
    report = tmp_path / "report"
    arguments = [str(folder), "--matcher", "sift", "--sigma", "0.2", "--report", str(report)]
    assert main(arguments) == 0
    assert f"wrote {report / 'index.html'}" in capsys.readouterr().out
    page = (report / "index.html").read_text()
    assert "<b>&amp; room" not in page
    assert "<b>&amp; room" in Page(page).text
    assert "--sigma 0.2" in Page(page).text
    record = (report / "results.jsonl").read_text()
    assert main(arguments) == 0
    assert "has 1 of the 1 results already" in capsys.readouterr().out
    assert (report / "results.jsonl").read_text() == record


@pytest.mark.parametrize("library", ["jinja2", "matplotlib"])
def test_what_is_missing_is_named(tmp_path, monkeypatch, library):
    for name in {library, *(name for name in sys.modules if name.partition(".")[0] == library)}:
        monkeypatch.setitem(sys.modules, name, None)
    results = [made(rotation_error_deg=0.1)]
    with pytest.raises(RuntimeError, match=f"{library} is needed for this and is not installed: pip install {library}"):
        write_report(tmp_path, [RunResults(RUN, [None], results)], "command")


# Tables

RUN = Run(Path("/scenes/room"), None, "paper", None, "default", "sift", 1.0, 0, 640)


def made(**changes):
    """A result of a right answer, but for `changes`."""
    result = QueryResult(
        photo="a.png",
        step=0,
        prior_rotation_error_deg=10.0,
        prior_translation_error=0.2,
        answered=True,
        success=True,
        rotation_error_deg=0.1,
        translation_error=0.001,
        status="localized",
        reason="found",
        evidence={"matches": 100, "inliers": 80, "passes": 3},
        milliseconds=200.0,
        cpu_milliseconds=300.0,
        stage_milliseconds={"render": 50.0, "match": 100.0, "total": 190.0},
        nees=1.0,
        in_ellipsoid={"50": False, "90": True, "95": True},
        protection_exceeded=False,
    )
    return replace(result, **changes)


def test_runs_are_put_together_over_their_seeds():
    others = [replace(RUN, seed=seed) for seed in range(4)]
    runs = [RunResults(run, [None], [made(photo=f"{run.seed}.png")]) for run in (*others, replace(RUN, sigma=2.0))]
    first, second = over_seeds(runs)
    assert (first.seeds, len(first.results), second.seeds) == ("0-3", 4, "0")
    assert Group(runs[:2]).seeds == "0,1"
    assert over_seeds([]) == []


def test_trust_is_counted_by_what_photos_and_maps_were_put_through():
    nothing = made(answered=False, success=False, nees=None, in_ellipsoid=None, protection_exceeded=None)
    far = made(nees=5.0, in_ellipsoid={"50": False, "90": False, "95": False}, protection_exceeded=True)
    wrong = replace(far, success=False)
    refused, believed = replace(nothing, success=True), replace(nothing, answered=True)
    hall = replace(RUN, scene=Path("/scenes/hall"))
    runs = [
        (RUN, [made(), nothing, far]),
        (hall, [made(cpu_milliseconds=100.0)]),
        (replace(RUN, protocol="near-miss"), [made()]),
        (replace(RUN, negative="/scenes/hall"), [refused, believed]),
        (replace(RUN, degradation="haze"), [wrong]),
        (replace(RUN, corruption="focal+5"), [made()]),
        (replace(RUN, corruption="dark"), [made()]),
    ]
    groups = over_seeds([RunResults(run, [None] * len(results), results) for run, results in runs])
    rows = trust_rows(groups)
    assert [(row.kind, row.name) for row in rows] == [
        ("right photos", ""),
        ("right photos", "priors of paper"),
        ("right photos", "priors of near-miss"),
        ("corrupted photos", ""),
        ("corrupted photos", "dark"),
        ("wrong calibrations", ""),
        ("wrong calibrations", "focal+5"),
        ("degraded maps", ""),
        ("degraded maps", "haze"),
        ("photos that are not of the scene", ""),
        ("photos that are not of the scene", "of hall"),
        ("all", ""),
    ]
    # Both scenes; NEES and what follows are of the answers.
    assert rows[1].cells() == ("4", "75.0 %", "0", "2.33", "67 %", "1 of 3", "300")
    assert rows[8].cells() == ("1", "0.0 %", "1", "5.00", "0 %", "1 of 1", "300")
    assert rows[10].cells() == ("2", "50.0 %", "1", "-", "-", "-", "300")
    assert (rows[-1].queries, rows[-1].right, rows[-1].wrong, rows[-1].beyond_level) == (10, 7, 2, 2)
    table = trust_table(groups).splitlines()
    assert len(table) == 1 + len(rows)
    assert table[1].startswith("right photos")
    assert table[2].startswith("  priors of paper")


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.dataset)
def test_published_figures_are_found_by_the_scenes_name(table):
    assert len(table.scenes) == {"Synthetic NeRF": 8, "Mip-NeRF360": 9, "Tanks and Temples": 21}[table.dataset]
    for scene in table.scenes:
        assert published_table(scene.capitalize()) is table
    # The share that the abstract rounds: 90 % of the first two data sets, 42 % of the third.
    proposed = table.rows[-1].success_rate
    assert round(100 * proposed) == {"Synthetic NeRF": 91, "Mip-NeRF360": 91, "Tanks and Temples": 42}[table.dataset]


def test_nothing_was_published_of_another_scene():
    assert published_table("kitchen sink") is None


# Figures


def texts(svg):
    """The texts in a figure, which must be XML that stands alone."""
    root = ElementTree.fromstring(svg)
    assert root.tag.endswith("svg")
    return [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]


@pytest.fixture
def named():
    rng = np.random.default_rng(0)
    results = [made(rotation_error_deg=e, translation_error=e / 100, nees=n) for e, n in rng.uniform(0.01, 2, (30, 2))]
    failed = made(answered=False, success=False, rotation_error_deg=0.0, translation_error=0.0, stage_milliseconds={})
    return [("ours <&>", results), ("theirs", [failed])]


def test_error_histograms(named):
    words = texts(figures.error_histograms(named))
    assert {"ours <&>", "theirs", "Rotation error", "Translation error", "5", "0.05"} <= set(words)


def test_calibration(named):
    words = texts(figures.calibration(named))
    assert {"ours <&>", "theirs", "if calibrated"} <= set(words)


def test_stage_times(named):
    words = texts(figures.stage_times(named))
    # What no stage accounts for is there too, and the total is not a stage.
    assert {"ours <&>", "render", "match", "other"} <= set(words)
    assert "total" not in words
    assert [word.strip() for word in words].count("200") >= 2


@pytest.mark.parametrize("rotation", [True, False])
def test_success_curves(named, rotation):
    words = texts(figures.success_curves(named, rotation))
    assert {"ours <&>", "theirs, wrong answers"} <= set(words)
    assert ("prior turned by, degrees" in words) == rotation


# Pictures


def grey(height, width, level):
    return np.full((height, width, 3), level, np.uint8)


def test_pictures_side_by_side():
    row = side_by_side([grey(4, 5, 10), grey(4, 7, 20), grey(4, 3, 30)])
    assert row.shape == (4, 5 + 7 + 3 + 12, 3)
    assert row[0, :, 0].tolist() == [10] * 5 + [255] * 6 + [20] * 7 + [255] * 6 + [30] * 3


def test_no_matches_mark_nothing():
    photo, render = grey(40, 50, 10), grey(40, 50, 20)
    np.testing.assert_array_equal(mark_matches(photo, render, Matches.none()), [photo, render])


def test_both_ends_of_a_match_are_ringed_in_one_colour():
    photo, render = grey(100, 120, 0), grey(100, 120, 0)
    matches = Matches(np.array([[20.0, 30.0], [60.0, 50.0]]), np.array([[80.0, 70.0], [100.0, 20.0]]), np.ones(2))
    marked = mark_matches(photo, render, matches)
    assert (photo == 0).all()
    colours = []
    for picture, ends in zip(marked, (matches.a, matches.b), strict=True):
        y, x = np.nonzero(picture.max(axis=2) > 100)
        distance = np.linalg.norm(np.column_stack([x, y])[:, None] - ends, axis=2)
        assert distance.min(axis=1).max() < 6  # nothing but rings
        assert (distance.min(axis=0) > 2).all()  # that leave the pixel itself to be seen
        colours.append([picture[int(v), int(u) + 4].tolist() for u, v in ends])
    assert colours[0] == colours[1]
    assert colours[0][0] != colours[0][1]


def test_of_many_matches_a_choice_from_left_to_right_is_marked():
    ends = np.column_stack([np.arange(4.0, 994.0), np.arange(4.0, 994.0) % 90 + 5])
    marked, _ = mark_matches(grey(100, 1000, 0), grey(100, 1000, 0), Matches(ends, ends, np.ones(len(ends))))
    assert min(marked[:, :40].max(), marked[:, 960:].max()) > 100
    one, _ = mark_matches(grey(100, 1000, 0), grey(100, 1000, 0), Matches(ends[:1], ends[:1], np.ones(1)))
    assert 20 < (marked.max(axis=2) > 100).sum() / (one.max(axis=2) > 100).sum() <= 81
