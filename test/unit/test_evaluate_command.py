"""The command: what it writes and prints, several processes, and going on where it was interrupted."""

import ast
import itertools
import json
import re
import shutil
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import joblib
import numpy as np
import pytest
from room_datasets import write_nerfstudio

import gsfeatloc_ros
from gsfeatloc_ros.common.geometry import quaternion_from_matrix
from gsfeatloc_ros.common.parameter import parameters_of
from gsfeatloc_ros.evaluate.corruptions import CORRUPTIONS
from gsfeatloc_ros.evaluate.degradations import DEGRADATIONS
from gsfeatloc_ros.evaluate.negatives import NEGATIVES
from gsfeatloc_ros.evaluate.plan import Combinations, Evaluation
from gsfeatloc_ros.evaluate.record import _NOT_MEASURED, Record, fingerprint_of, hash_scene
from gsfeatloc_ros.evaluate.run import Run, draw_priors, trace
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.evaluate.suites import SUITES
from gsfeatloc_ros.evaluate.tables import Group
from gsfeatloc_ros.index import IndexOptions
from gsfeatloc_ros.index.storage import SUFFIX, load_index
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.simulate import simulate_photos
from gsfeatloc_ros.tools.evaluate import main

# The room is small for the paper's priors: a lesser sigma keeps them out of the walls.
QUICK = ["--matcher", "sift", "--sigma", "0.3"]


@pytest.fixture(scope="module")
def photos(room, room_camera):
    return simulate_photos(room, room_camera.scaled(320, 240), count=4, seed=5)


@pytest.fixture
def room_scene(tmp_path, room_camera, photos, room_map_file):
    folder = tmp_path / "room"
    folder.mkdir()
    return write_nerfstudio(folder, room_camera.scaled(320, 240), photos, room_map_file)


def read(path):
    return json.loads(path.read_text())


def without_times(report):
    """Results without what no two runs have in common."""
    return [
        {key: value for key, value in result.items() if "milliseconds" not in key} for result in report["per_query"]
    ]


@pytest.mark.slow
def test_several_of_everything_in_one_call(room_scene, tmp_path, capsys):
    path = tmp_path / "all.json"
    lists = ["--method", "default,published", "--seed", "3-4", "--protocol", "paper,chen", "--limit", "1"]
    assert main([str(room_scene), *QUICK, *lists, "--json", str(path)]) == 0
    report = read(path)
    combinations = [(run["method"], run["protocol"], run["seed"]) for run in report["runs"]]
    assert sorted(combinations) == [
        (method, protocol, seed)
        for method in ("default", "published")
        for protocol in ("chen", "paper")
        for seed in (3, 4)
    ]
    for run in report["runs"]:
        assert len(run["per_query"]) == run["queries"] == (5 if run["protocol"] == "chen" else 1)
        assert [result["step"] for result in run["per_query"]] == list(range(run["queries"]))
        if run["protocol"] == "chen":
            assert run["best_of_priors"]["queries"] == 1
            assert run["best_of_priors"]["success_rate"] >= run["success_rate"]
        assert (run["coverage"] is None) == (run["method"] == "published")
    pooled = {(group["method"], group["protocol"]): group for group in report["pooled"]}
    assert len(pooled) == len(report["pooled"]) == 4
    assert pooled["default", "chen"]["seed"] == "3,4"
    assert pooled["default", "chen"]["queries"] == 10
    assert pooled["default", "chen"]["best_of_priors"]["queries"] == 2
    table = capsys.readouterr().out.splitlines()
    assert len(table) == 5
    assert table[0].split()[:3] == ["scene", "protocol", "sigma"]
    assert all(line.startswith("room") for line in table[1:])


@pytest.mark.slow
def test_each_seed_has_an_index_of_its_own(room_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("gsfeatloc_ros.evaluate.run.IndexOptions", partial(IndexOptions, views=8))
    assert main([str(room_scene), "--protocol", "no-prior,planar", "--seed", "0,1", "--limit", "1"]) == 0
    one, other = (load_index(path).poses for path in tmp_path.rglob(f"*{SUFFIX}"))
    assert not np.array_equal(one, other)


@pytest.mark.slow
def test_sweep_is_reported_by_step(room_scene, tmp_path, capsys):
    path = tmp_path / "sweep.json"
    assert main([str(room_scene), *QUICK, "--protocol", "sweep-rotation", "--limit", "1", "--json", str(path)]) == 0
    report = read(path)
    assert [step["queries"] for step in report["steps"]] == [1] * 11
    errors = [step["prior_rotation_error_deg"] for step in report["steps"]]
    np.testing.assert_allclose(errors, np.linspace(0, errors[-1], 11), atol=1e-4)
    assert report["steps"][0]["success_rate"] == 1.0
    assert capsys.readouterr().out.count("prior off by") == 11


@pytest.mark.slow
def test_priors_of_another_system(room_scene, photos, tmp_path):
    path = tmp_path / "report.json"
    prior = photos[2].T_map_camera_prior
    numbers = [*prior[:3, 3], *quaternion_from_matrix(prior[:3, :3])]
    (tmp_path / "odometry.txt").write_text(f"2 {' '.join(map(str, numbers))}\n")
    options = ["--protocol", "priors-file", "--priors", str(tmp_path / "odometry.txt")]
    assert main([str(room_scene), *QUICK, *options, "--json", str(path)]) == 0
    (result,) = read(path)["per_query"]
    assert result["photo"] == "2.png"
    assert 10 <= result["prior_rotation_error_deg"] <= 30
    assert result["success"]


def test_options_of_the_localizer_are_changed(room_scene, tmp_path):
    path = tmp_path / "inliers.json"
    lists = ["--method", "default,published", "--set", "min_inliers=20,5000", "--set", "max_views=0", "--limit", "1"]
    assert main([str(room_scene), *QUICK, *lists, "--json", str(path)]) == 0
    runs = read(path)["runs"]
    assert [(run["method"], run["options"]) for run in runs] == [
        ("default", {"min_inliers": 20, "max_views": 0}),
        ("default", {"min_inliers": 5000, "max_views": 0}),
        ("published", {}),
    ]
    assert [run["answered"] for run in runs[:2]] == [1, 0]


@pytest.mark.slow
def test_parts_are_taken_out_and_photos_corrupted_one_at_a_time(room_scene, tmp_path, capsys):
    path = tmp_path / "worse.json"
    # The old names, which work with a notice.
    lists = ["--without", "nothing,sub-pixel", "--spoil", "nothing,dark", "--limit", "1"]
    assert main([str(room_scene), *QUICK, "--method", "default,published", *lists, "--json", str(path)]) == 0
    runs = read(path)["runs"]
    assert [(run["method"], run["ablation"], run["corruption"]) for run in runs] == [
        ("default", "", ""),
        ("default", "", "dark"),
        ("default", "sub-pixel", ""),
        ("default", "sub-pixel", "dark"),
        ("published", "", ""),
        ("published", "", "dark"),
    ]
    errors = [run["per_query"][0]["rotation_error_deg"] for run in runs]
    assert len(set(errors)) == len(errors)
    said = capsys.readouterr().err
    for old, new in (("--without", "--ablation"), ("--spoil", "--corruption")):
        assert f"{old} is now {new}; the old name works until the next release" in said


@pytest.mark.slow
def test_maps_are_degraded_one_way_at_a_time(room_scene, tmp_path, capsys):
    path = tmp_path / "degraded.json"
    assert main([str(room_scene), *QUICK, "--degrade", "nothing,haze,grown", "--limit", "1", "--json", str(path)]) == 0
    runs = read(path)["runs"]
    assert [run["degradation"] for run in runs] == ["", "haze", "grown"]
    assert len({run["per_query"][0]["rotation_error_deg"] for run in runs}) == 3
    assert "default sift haze map" in capsys.readouterr().out


@pytest.fixture(scope="module")
def trust(tmp_path_factory, room_camera, photos, room_map_file):
    """The folder of what `--suite trust` wrote of one photo, and the arguments."""
    folder = tmp_path_factory.mktemp("trust")
    (folder / "room").mkdir()
    scene = write_nerfstudio(folder / "room", room_camera.scaled(320, 240), photos[:1], room_map_file)
    arguments = [str(scene), *QUICK, "--suite", "trust", "--set", "max_views=0"]
    assert main([*arguments, "--json", str(folder / "trust.json"), "--report", str(folder)]) == 0
    return folder, arguments


@pytest.mark.slow
def test_the_suite_runs_everything(trust):
    folder, _ = trust
    report = read(folder / "trust.json")
    runs = report["runs"]
    assert [run["corruption"] for run in runs if run["corruption"] and not run["negative"]] == list(CORRUPTIONS)
    assert [run["degradation"] for run in runs if run["degradation"]] == list(DEGRADATIONS)
    assert [run["negative"] for run in runs if run["negative"] and not run["corruption"]] == list(NEGATIVES)
    both = {(run["negative"], run["corruption"]) for run in runs if run["negative"] and run["corruption"]}
    assert both > {("mirrored", "motion-25"), ("mirrored", "cover-40"), ("mirrored", "small-80")}
    assert [run["protocol"] for run in runs].count("near-miss") == 1
    assert all(run["queries"] == 1 for run in runs)
    total = report["trust"][-1]
    assert (total["kind"], total["name"], total["queries"], total["wrong"]) == ("all", "", len(runs), 0)
    rows = {row["name"]: row for row in report["trust"]}
    assert rows["dark"]["kind"] == "corrupted photos"
    assert rows["haze"]["kind"] == "degraded maps"
    assert rows["black"] == rows["black"] | {"queries": 1, "right": 1, "wrong": 0, "nees": None, "answers": 0}
    assert rows["priors of paper"] == rows["priors of paper"] | {"right": 1, "answers": 1}
    assert rows["priors of paper"]["cpu_milliseconds"] > 0
    page = (folder / "index.html").read_text()
    assert page.count("Whether answers can be trusted") == 1
    assert "photos that are not of the scene" in page
    # All but the figures of the right photos would be a jumble.
    assert page.count("<svg") == 2 * 3


@pytest.mark.slow
def test_the_suite_goes_on_where_it_was(trust, capsys):
    folder, arguments = trust
    record = folder / "results.jsonl"
    # Beside the new report: that page is not drawn again.
    (folder / "again.jsonl").write_text("".join(record.read_text().splitlines(keepends=True)[:-4]))
    queries = read(folder / "trust.json")["trust"][-1]["queries"]
    assert main([*arguments, "--json", str(folder / "again.json")]) == 0
    printed = capsys.readouterr().out
    assert f"has {queries - 2} of the {queries} results already" in printed
    lines = [re.split("  +", line.strip())[0] for line in printed.splitlines()]
    kinds = ["right photos", "corrupted photos", "wrong calibrations", "degraded maps"]
    kinds += ["photos that are not of the scene", "all"]
    assert [line for line in lines if line in kinds] == kinds
    assert {"near-miss", "focal+5", "bent-0.5", "mirror-pose"} <= {line.removeprefix("priors of ") for line in lines}


def test_in_the_suite_the_photos_of_each_scene_are_looked_for_in_all_others():
    scenes = [(Path(f"/scenes/{name}"), None, None) for name in ("bonsai", "lego", "office")]
    conditions = SUITES["trust"]
    runs = Combinations(scenes, conditions, None, ["default"], ["sift"], [1.0], [0, 1], 640, {}).runs()
    assert len(runs) == len(set(runs)) == 2 * (3 * (len(conditions) - 1) + 6)
    others = {(run.scene.name, Path(run.negative).name) for run in runs if run.negative not in ("", *NEGATIVES)}
    assert others == {(a.name, b.name) for a, _, _ in scenes for b, _, _ in scenes if a != b}
    # A map is not degraded, or read, more often than needed.
    maps = [(run.scene, run.degradation) for run in runs]
    assert len(set(maps)) == sum(a != b for a, b in itertools.pairwise(maps)) + 1


@pytest.mark.slow
def test_negatives_are_corrupted_as_photos_are(room_scene):
    plain = Run(room_scene, None, "paper", None, "default", "sift", 0.1, 0, 640, negative="mirrored")
    mirrored, covered = (
        trace(Evaluation([run], 1, Record(None)).to_do[0]).photo.image
        for run in (plain, replace(plain, corruption="half-white"))
    )
    # The distortion is taken out after that, which moves the border a little.
    np.testing.assert_array_equal(covered[:, :300], mirrored[:, :300])
    assert (covered[:, 340:] == 255).all()


@pytest.mark.slow
def test_an_answer_to_a_photo_of_another_scene_is_wrong(room_scene, tmp_path):
    # The hall is the room, so that there is an answer; no map is needed for its photos.
    hall = tmp_path / "hall"
    shutil.copytree(room_scene, hall)
    (hall / "map.ply").unlink()
    run = Run(room_scene, None, "paper", None, "default", "sift", 0.1, 0, 640, negative=str(hall))

    def evaluation():
        return Evaluation([run], 1, Record(tmp_path / "results.jsonl"))

    first = evaluation()
    assert len(list(first.localize(1))) == 1
    (results,) = first.results()
    (result,) = results.results
    assert (result.photo, result.verdict, result.success, result.nees) == ("0.png", "wrong", False, None)
    assert (Group([results]).label, Group([results]).describe()["negative"]) == (
        "default sift not of the scene: of hall",
        "hall",
    )
    assert evaluation().to_do == []
    # Its photos are part of what the result depends on.
    transforms = read(hall / "transforms.json")
    (hall / "transforms.json").write_text(json.dumps(transforms | {"cx": 160.0}))
    assert len(evaluation().to_do) == 1


@pytest.mark.slow
def test_two_processes_find_what_one_does(room_scene, tmp_path):
    for jobs in ("1", "2"):
        options = ["--limit", "2", "--jobs", jobs, "--json", str(tmp_path / f"{jobs}.json")]
        assert main([str(room_scene), *QUICK, *options]) == 0
    one, two = (read(tmp_path / f"{jobs}.json") for jobs in "12")
    assert one["queries"] == 2
    assert without_times(one) == without_times(two)


@pytest.mark.slow
def test_joblibs_own_configuration_chooses_the_backend(room_scene, tmp_path):
    path = tmp_path / "report.json"
    with joblib.parallel_config(backend="threading", n_jobs=2):
        assert main([str(room_scene), *QUICK, "--limit", "2", "--json", str(path)]) == 0
    assert read(path)["queries"] == 2


# Going on


@pytest.mark.slow
def test_what_is_done_is_not_done_again(room_scene, tmp_path, capsys):
    path = tmp_path / "report.json"
    arguments = [str(room_scene), *QUICK, "--json", str(path)]
    assert main([*arguments, "--limit", "2"]) == 0
    lines = path.with_suffix(".jsonl").read_text().splitlines()
    first = read(path)
    assert main([*arguments, "--limit", "3"]) == 0
    assert "has 2 of the 3 results already" in capsys.readouterr().out
    again = read(path)
    # The very times are those of the first run.
    assert again["per_query"][:2] == first["per_query"]
    assert path.with_suffix(".jsonl").read_text().splitlines()[:3] == lines
    assert main([*arguments, "--limit", "1"]) == 0
    assert read(path)["per_query"] == first["per_query"][:1]


@pytest.mark.slow
def test_a_line_cut_short_is_done_again(room_scene, tmp_path, capsys):
    path = tmp_path / "report.json"
    record = path.with_suffix(".jsonl")
    arguments = [str(room_scene), *QUICK, "--limit", "2", "--json", str(path)]
    assert main(arguments) == 0
    first = read(path)
    record.write_text(record.read_text()[:-40])
    assert main(arguments) == 0
    assert "has 1 of the 2 results already" in capsys.readouterr().out
    assert without_times(read(path)) == without_times(first)
    assert main(arguments) == 0
    assert "has 2 of the 2 results already" in capsys.readouterr().out


@pytest.mark.slow
def test_another_setting_starts_over_and_keeps_the_others(room_scene, tmp_path, capsys):
    path = tmp_path / "report.json"
    for seed, there in (("0", ""), ("1", "has 0 of the 1 results already"), ("0", "has 1 of the 1 results already")):
        arguments = [str(room_scene), *QUICK, "--limit", "1", "--seed", seed, "--json", str(path)]
        assert main(arguments) == 0
        printed = capsys.readouterr().out
        assert there in printed
        assert ("already" in printed) == bool(there)
        assert read(path)["seed"] == int(seed)


@pytest.mark.slow
def test_another_map_starts_over(room_scene, tmp_path, capsys):
    path = tmp_path / "report.json"
    arguments = [str(room_scene), *QUICK, "--limit", "1", "--json", str(path)]
    assert main(arguments) == 0
    first = read(path)
    gaussians = load_map(room_scene / "map.ply")
    gaussians.means[:, 0] += 0.5
    write_ply(room_scene / "map.ply", gaussians)
    capsys.readouterr()
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "map changed, 1 results start over" in printed
    # It is the new map that was localized in, half a metre off.
    moved = read(path)["per_query"][0]["translation_error"] - first["per_query"][0]["translation_error"]
    assert moved * radius(room_scene) == pytest.approx(0.5, abs=0.1)


def radius(folder):
    centres = load_scene(folder).trajectory[:, :3, 3]
    return np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()


def test_fingerprint_knows_what_results_depend_on(room_scene, monkeypatch):
    def fingerprint(sigma=1.0):
        run = Run(room_scene, None, "paper", None, "default", "sift", sigma, 0, 640)
        scene = load_scene(room_scene)
        return fingerprint_of(run, hash_scene(scene), draw_priors(run, scene))

    def differ(before, after):
        return [part for part, value in asdict(before).items() if value != asdict(after)[part]]

    before = fingerprint()
    assert fingerprint() == before
    assert differ(before, fingerprint(sigma=2.0)) == ["settings", "priors"]
    monkeypatch.setattr("gsfeatloc_ros.evaluate.record._code", lambda: "newer")
    assert differ(before, fingerprint()) == ["code"]
    transforms = read(room_scene / "transforms.json")
    (room_scene / "transforms.json").write_text(json.dumps(transforms | {"cx": 160.0}))
    assert differ(before, fingerprint()) == ["code", "photos"]


def test_nothing_that_is_measured_imports_what_no_result_depends_on():
    root = Path(gsfeatloc_ros.__file__).parent
    unmeasured = [root / name for name in _NOT_MEASURED]
    assert all(room.is_dir() for room in unmeasured)
    names = {f"gsfeatloc_ros.{name.replace('/', '.')}" for name in _NOT_MEASURED}
    for source in root.rglob("*.py"):
        if any(map(source.is_relative_to, unmeasured)):
            continue
        for node in ast.walk(ast.parse(source.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert not any(f"{node.module}.".startswith(f"{name}.") for name in names), source


# What the command refuses


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--matcher", "sift,nothing"], "nothing is not one of sift"),
        (["--method", "other"], "other is not one of default, published"),
        (["--protocol", "chan"], "chan is not one of paper"),
        (["--seed", "0-x"], "'0-x' is not a whole number"),
        (["--seed", ""], "'' is not a whole number"),
        (["--sigma", "1,-1"], "'-1' is not a number of at least 0"),
        (["--set", "passes=1"], "passes=1 is not OPTION=VALUE"),
        (["--set", "max_passes"], "max_passes is not OPTION=VALUE"),
        (["--set", "max_passes=1.5"], "'1.5' is not a whole number"),
        (["--set", "max_passes=1,0"], "max_passes: 0 is not within 1 and 20"),
        (["--set", "prior_rotation=0"], "prior_rotation: 0.0 is not within 0.01 and 180"),
        (["--set", "prior_rotation=nan"], "'nan' is not a number"),
        (["--set", "seed=1"], "seed=1 is not OPTION=VALUE"),
        (["--set", "cauchy_scale=1"], "cauchy_scale=1 is not OPTION=VALUE"),
        (["--set", "min_inlier_ratio=0.3"], "min_inlier_ratio is no option any more: use max_risk, the largest"),
        (["--set", "min_correlation=0.3"], "min_correlation is no option any more: use max_risk, the largest"),
        (["--set", "min_agreement=0.3"], "min_agreement is no option any more: use max_risk, the largest"),
        (["--degrade", "fog"], "fog is not one of nothing, dropped"),
        (["--suite", "all"], "invalid choice: 'all'"),
        (["--suite", "trust", "--corruption", "dark"], "--suite trust has its own --corruption"),
        (["--suite", "trust", "--degrade", "haze"], "--suite trust has its own --degrade"),
        (["--suite", "trust", "--protocol", "chen"], "--suite trust has its own --protocol"),
        (["--ablation", "renderer"], "renderer is not one of nothing, tracking"),
        (["--without", "renderer"], "renderer is not one of nothing, tracking"),
        (["--jobs", "0"], "'0' is not a whole number of at least 1"),
        (["--protocol", "priors-file"], "--priors and --protocol priors-file need each other"),
        (["--priors", "a.txt"], "--priors and --protocol priors-file need each other"),
        (["--map", "a.ply", "--map", "b.ply"], "--map: 2 files for 1 scenes"),
        (["--dataparser-transforms", "a", "--dataparser-transforms", "b"], "transforms: 2 files for 1 scenes"),
        (["--report", "/nowhere/at/all"], "--report /nowhere/at/all: there is no folder /nowhere/at"),
    ],
)
def test_options_that_make_no_sense(tmp_path, wrong, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path), *wrong])
    assert message in capsys.readouterr().err


def test_help_names_the_options_of_the_localizer(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    printed = "".join(capsys.readouterr().out.split())
    own = ("max_image_width", "seed")  # --max-width and --seed
    names = [parameter.name for parameter in parameters_of(LocalizerOptions) if parameter.name not in own]
    assert {"max_views", "max_reprojection_error", "min_inliers"} < set(names)
    assert ",".join(names) in printed
    assert "--without" not in printed


def test_command_on_a_folder_without_a_scene(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "transforms.json" in capsys.readouterr().err


def test_command_on_a_scene_without_a_map(room_scene, capsys):
    (room_scene / "map.ply").unlink()
    assert main([str(room_scene)]) == 2
    assert "holds no map (map.ply, " in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrong",
    [["--sigma", "-1"], ["--sigma", "nan"], ["--limit", "x"], ["--max-width", "0"], ["--json", "/nowhere/a.json"]],
)
def test_command_refuses_wrong_options_before_it_starts(tmp_path, wrong, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path), *wrong])
    assert wrong[0] in capsys.readouterr().err
