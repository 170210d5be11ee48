"""The command that evaluates, on real photos."""

from __future__ import annotations

import json

import pytest

from gsfeatloc_ros.tools.evaluate import main


@pytest.mark.parametrize("method", ["default", "published"])
def test_command_writes_its_report(scenes, tmp_path, capsys, method):
    path = tmp_path / "report.json"
    scene = str(scenes / "bonsai")
    assert (
        main([scene, "--method", method, "--matcher", "sift", "--limit", "2", "--sigma", "0.3", "--json", str(path)])
        == 0
    )
    report = json.loads(path.read_text())
    assert list(report) == [
        "scene",
        "protocol",
        "method",
        "matcher",
        "sigma",
        "seed",
        "options",
        "ablation",
        "corruption",
        "degradation",
        "negative",
        "queries",
        "success_rate",
        "rotation_error_deg",
        "translation_error",
        "answered",
        "wrong_answers",
        "milliseconds",
        "cpu_milliseconds",
        "nees_mean",
        "nees_median",
        "coverage",
        "protection_exceeded",
        "per_query",
    ]
    assert (report["scene"], report["protocol"], report["method"]) == ("bonsai", "paper", method)
    assert (report["matcher"], report["sigma"], report["seed"], report["queries"]) == ("sift", 0.3, 0, 2)
    assert report["success_rate"] == 1.0
    assert report["rotation_error_deg"]["median"] < 1.0
    assert report["milliseconds"]["median"] > 0
    printed = capsys.readouterr().out
    assert "DSCF5565.jpg" in printed
    assert "100.0 % of 2" in printed


def test_command_gives_the_same_answer_to_the_same_seed(scenes, tmp_path):
    reports = []
    for number, limit in enumerate(("1", "2")):
        path = tmp_path / f"{number}.json"
        scene = str(scenes / "lego")
        main(
            [scene, "--method", "published", "--matcher", "sift", "--seed", "5", "--limit", limit, "--json", str(path)]
        )
        reports.append(json.loads(path.read_text())["per_query"][0])
        del reports[-1]["milliseconds"]
        del reports[-1]["cpu_milliseconds"]
        del reports[-1]["stage_milliseconds"]
    assert reports[0] == reports[1]
