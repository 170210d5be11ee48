"""The script that compares results: what counts as the same, and what it says of the rest."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "compare_answers.py"
spec = importlib.util.spec_from_file_location("compare_answers", SCRIPT)
assert spec is not None
assert spec.loader is not None
compare_answers = importlib.util.module_from_spec(spec)
spec.loader.exec_module(compare_answers)

OLD = {
    "scene": "bonsai",
    "protocol": "paper",
    "seed": 0,
    "options": {"min_agreement": 0.5},
    "without": "",
    "spoil": "dark",
    "milliseconds": {"median": 3.0},
    "per_query": [
        {
            "photo": "a.png",
            "step": 0,
            "inliers": 20,
            "rotation_error_deg": 0.1,
            "nees": None,
            "milliseconds": 5.0,
            "evidence": {"agreement": 0.7, "views": 0.0},
            "in_ellipsoid": {"50": True, "90": True},
        }
    ],
}
NEW = {
    "scene": "bonsai",
    "protocol": "paper",
    "seed": 0,
    "options": {"min_correlation": 0.5},
    "ablation": "",
    "corruption": "dark",
    "degradation": "",
    "negative": "",
    "per_query": [
        {
            "photo": "a.png",
            "step": 0,
            "rotation_error_deg": 0.1,
            "nees": None,
            "milliseconds": 6.0,
            "cpu_milliseconds": 7.0,
            "evidence": {"corners": 30, "inliers": 20, "correlation": 0.7, "views": 0},
            "in_ellipsoid": {"90": True, "50": True},
        }
    ],
}


def compare(tmp_path: Path, before: object, after: object) -> int:
    for name, content in (("before", before), ("after", after)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    return compare_answers.main([str(tmp_path / "before.json"), str(tmp_path / "after.json")])


def changed(**changes: object) -> dict:
    return NEW | {"per_query": [NEW["per_query"][0] | changes]}


def test_old_names_new_fields_and_times_make_no_difference(tmp_path, capsys):
    assert compare(tmp_path, OLD, NEW) == 0
    assert "1 of 1 queries are identical" in capsys.readouterr().out
    assert compare(tmp_path, {"runs": [OLD]}, {"runs": [NEW]}) == 0


@pytest.mark.parametrize(
    ("after", "says"),
    [
        (changed(rotation_error_deg=0.1 + 2e-17), "rotation_error_deg 0.1 -> 0.10000000000000002"),
        (changed(nees=1.0), "nees None -> 1.0"),
        (changed(in_ellipsoid={"50": True, "90": False}), "in_ellipsoid"),
        (changed(evidence={"inliers": 20, "views": 0}), "correlation 0.7 -> 'missing'"),
        (changed(evidence={"inliers": 21, "correlation": 0.7, "views": 0}), "inliers 20 -> 21"),
        (changed(photo="b.png"), "photo 'b.png', step 0x0.0p+0: only after"),
        (NEW | {"corruption": ""}, "only before"),
        (NEW | {"degradation": "haze"}, "only before"),
    ],
)
def test_what_differs_is_listed(tmp_path, capsys, after, says):
    assert compare(tmp_path, OLD, after) == 1
    printed = capsys.readouterr().out
    assert says in printed
    assert "0 of " in printed


def test_negatives_are_told_apart_by_their_kind(tmp_path):
    before = [{"scene": "lego", "kind": kind, "photo": "a", "agreement": None, "cpu_seconds": 1} for kind in "xy"]
    after = [{"scene": "lego", "kind": kind, "photo": "a", "correlation": None} for kind in "yx"]
    assert compare(tmp_path, before, after) == 0
    assert compare(tmp_path, before, after[:1]) == 1


def test_images_of_a_bag(tmp_path):
    (tmp_path / "before.csv").write_text("bag_time,status,agreement,ms\n1.0,localized,0.5,7\n2.0,failed,,3\n")
    (tmp_path / "after.csv").write_text("bag_time,status,correlation,ms\n1.0,localized,0.5,8\n2.0,failed,,3\n")
    before, after = str(tmp_path / "before.csv"), str(tmp_path / "after.csv")
    assert compare_answers.main([before, after]) == 0
    (tmp_path / "after.csv").write_text("bag_time,status,correlation,ms\n1.0,localized,0.6,8\n2.0,failed,,3\n")
    assert compare_answers.main([before, after]) == 1


@pytest.mark.parametrize("content", [{}, [], [{"photo": "a"}, {"photo": "a"}], "text"])
def test_what_is_no_file_of_results_cannot_be_compared(tmp_path, capsys, content):
    assert compare(tmp_path, content, content) == 2
    assert capsys.readouterr().err.startswith("compare_answers: ")
