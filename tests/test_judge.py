"""The bars: what they read, and the command that measures it."""

import dataclasses
import json
from pathlib import Path

import pytest
from states import BIPED, random_params

from kslc_jax import config, curriculum, judge, robot, similar
from kslc_jax import policy as policy_lib
from kslc_jax.evaluation import judging, scheduled, tables, variation
from kslc_jax.evaluation import measure as measuring
from kslc_jax.evaluation.bars import HARSH, bars
from kslc_jax.evaluation.perturbations import ALL
from kslc_jax.evaluation.size import FULL, ROBOTS


def row(command, **changes):
    """A speed that meets every bar."""
    good = {
        "survival": 1.0,
        "forward_mean": command,
        **({} if command else {"drift": 0.002}),
        "lateral_mean": 0.0,
        "stride_frequency": 1.5 if command else 0.0,
        "within_speed_limits": 1.0,
        "shoulder_hip_correlation": -0.9 if command else 0.0,
        "stance_difference": 0.02,
        "knee_range_difference": 0.01,
        "lateral_std": 0.05,
        "yaw_rate_std": 0.1,
        "flight_share": 0.3,
    }
    return {"command": command} | good | changes


def good():
    """Results that meet every bar."""
    return {
        "speeds": [row(0.0), row(0.5), row(3.5), row(4.0), row(4.5, survival=0.0)],
        "schedules": {"heading=0.00": [{"schedule": "random", "survival": 1.0}]},
        "perturbed": {"payload=5": [row(1.0), row(3.0)]},
    }


def test_a_good_policy_meets_all_bars():
    """The row of 4.5 m/s is only reported."""
    found = bars(good())
    assert len(found) == 13 and all(bar.met for bar in found)


@pytest.mark.parametrize(
    ("at", "changes", "name", "value"),
    [
        (3, {"survival": 0.5}, "nobody falls, 0 to 4 m/s", 0.5),
        (1, {"forward_mean": 0.45}, "speed error, 0.5 to 4 m/s, share", 0.1),
        (0, {"forward_mean": -0.05}, "speed at command 0 [m/s]", 0.05),
        (0, {"drift": 0.01}, "drift at command 0 [m/s]", 0.01),
        (0, {"stride_frequency": 1.0}, "strides a second at command 0", 1.0),
        (2, {"within_speed_limits": 0.9}, "joints within speed limits, to 3.5 m/s", 0.9),
        (1, {"shoulder_hip_correlation": 0.8}, "arm-leg correlation", 0.8),
        (1, {"knee_range_difference": 0.2}, "left-right difference", 0.2),
        (2, {"lateral_std": 0.2}, "lateral std, to 3.5 m/s [m/s]", 0.2),
        (2, {"yaw_rate_std": 0.3}, "yaw-rate std, to 3.5 m/s [rad/s]", 0.3),
        (2, {"flight_share": 0.05}, "flight at 3.5 m/s", 0.05),
    ],
)
def test_each_bar_tells_the_worst_and_where(at, changes, name, value):
    results = good()
    results["speeds"][at] |= changes
    (missed,) = [bar for bar in bars(results) if not bar.met]
    assert missed.name == name and missed.value == pytest.approx(value)
    assert missed.where == f"{results['speeds'][at]['command']:g} m/s"


def test_a_speed_at_which_all_fell_meets_no_bar_on_the_gait():
    """Such a row has no metrics of the gait: they are not those of the slower speeds."""
    results = good()
    results["speeds"][2] = {"command": 3.5, "survival": 0.0, "forward_mean": 0.0}
    found = {bar.name: bar for bar in bars(results)}
    for name in (
        "joints within speed limits, to 3.5 m/s",
        "arm-leg correlation",
        "left-right difference",
        "lateral std, to 3.5 m/s [m/s]",
        "yaw-rate std, to 3.5 m/s [rad/s]",
        "flight at 3.5 m/s",
    ):
        assert not found[name].met and found[name].where == "3.5 m/s: all fell", name


@pytest.mark.parametrize("part", ["schedules", "perturbed"])
def test_a_fall_under_any_condition_is_told(part):
    results = good()
    condition, rows = next(iter(results[part].items()))
    rows[-1]["survival"] = 0.75
    (missed,) = [bar for bar in bars(results) if not bar.met]
    assert missed.value == 0.75 and missed.where.startswith(condition)


def test_drake_is_a_bar_where_it_was_tried():
    results = good() | {"drake": [row(1.0, survival=0.0)]}
    (missed,) = [bar for bar in bars(results) if not bar.met]
    assert missed.name.startswith("nobody falls, Drake")


def test_harsh_conditions_are_bars_where_they_were_tried():
    """Each has its own share that must survive."""
    rows = [row(0.0), row(1.0, survival=0.96)]
    parts = {"punch=300": {"wanted": 0.95, "rows": rows}, "arms=1": {"wanted": 1.0, "rows": rows}}
    found = bars(good() | {"harsh": parts})
    assert len(found) == 15
    (missed,) = [bar for bar in found if not bar.met]
    assert missed.name == "share that does not fall, arms=1" and missed.value == 0.96
    assert missed.where == "1 m/s"


def test_a_share_of_0_is_only_reported():
    parts = {"punch=500": {"wanted": 0.0, "rows": [row(0.0), row(1.0, survival=0.25)]}}
    results = bars(good() | {"harsh": parts})
    (found,) = [bar for bar in results if not bar.requires]
    assert (found.value, found.where, found.met) == (0.25, "1 m/s", True)
    shown = list(judge.table(results, "").columns[4].cells)
    assert shown == ["yes"] * 13 + ["-"]
    side = judge.side_by_side({"a": {"bars": results}})
    assert "misses 0 of 13 bars" in str(side.caption)


def test_harsh_conditions_are_tried_as_named(monkeypatch):
    seen = []

    def measure(policy, setting, speeds, seeds, seed, progress, describe):
        seen.append((setting, tuple(speeds), seeds))
        return [row(speed) for speed in speeds]

    monkeypatch.setattr(measuring, "measure", measure)
    policy = policy_lib.load_policy("xbot_l_run")
    found = judging.harsh(policy, FULL, 0, lambda share: None)
    assert [name for name in found] == list(HARSH) and found["punch=300"]["wanted"] == 0.95
    punched, harder, held, rough, waves, slope = (setting for setting, _, _ in seen)
    assert punched.randomize.punch == (300, 300) and punched.seconds == 30
    assert harder.randomize.punch == (500, 500) and found["punch=500"]["wanted"] == 0.0
    assert held.randomize.held_arms == 1 and not held.physics.terrain.kinds
    assert rough.physics.terrain.rough == 0.05 and slope.physics.terrain.slope == 10
    assert seen[4][1:] == ((3.0,), 32) and waves.physics.terrain.rough == 0.03


def test_harsh_conditions_fit_the_size_of_the_robot():
    """A force scales with the mass, a height with the length; without arms nobody moves them."""
    xbot = robot.load()
    assert variation.for_robot(list(HARSH), xbot) == tuple(HARSH)
    small = dataclasses.replace(xbot, length_ratio=0.25, mass_ratio=0.5)
    own = ("punch=150", "punch=250", "arms=1", "rough:0.013", "rough:0.0075", "slope:10")
    assert variation.for_robot(list(HARSH), small) == own
    biped = robot.load(name=str(Path(__file__).parent / "data" / "biped.toml"))
    assert [name[:4] for name in variation.for_robot(list(HARSH), biped)] == [
        *("punc", "punc", "roug", "roug", "slop")
    ]


def test_what_was_not_measured_is_not_met():
    """A policy that falls at once has no gait to measure."""
    results = good() | {"speeds": [{"command": 0.5, "survival": 0.0, "forward_mean": 0.0}]}
    found = {bar.name: bar for bar in bars(results)}
    assert found["arm-leg correlation"].value is None and not found["arm-leg correlation"].met
    assert found["arm-leg correlation"].shown() == "-"


def test_a_smaller_robot_has_slower_bars_and_one_without_arms_has_none_on_them():
    """At a quarter of the length all speeds are half as fast; a speed beyond the top is no bar."""
    results = good()
    for part in (results["speeds"], results["perturbed"]["payload=5"]):
        for line in part:
            line |= {"command": line["command"] / 2, "forward_mean": line["forward_mean"] / 2}
    found = bars(results, scale=0.5, arms=False)
    assert len(found) == 12 and all(bar.met for bar in found)
    assert found[0].name == "nobody falls, 0 to 2 m/s"
    results["speeds"][3]["survival"] = 0.5
    (missed,) = [bar for bar in bars(results, scale=0.5) if not bar.met]
    assert missed.where == "2 m/s"


def test_a_robot_of_another_size_is_tried_at_its_own_speeds():
    """Lengths scale with l, speeds with sqrt(l), masses with m, torques with m l."""
    xbot = robot.load("high")
    assert judging.for_robot(FULL, xbot) == FULL
    quarter = dataclasses.replace(xbot, length_ratio=0.25, mass_ratio=0.5)
    small = judging.for_robot(FULL, quarter)
    assert small.top == 2.0
    assert small.speeds == (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25)
    assert small.perturbed_speeds == (0.5, 1.0, 1.5) and small.headings == FULL.headings
    theirs = dict(zip(ALL, small.perturbations, strict=True))
    changed = {
        "payload=-5": "payload=-2.5",
        "payload=5": "payload=2.5",
        "com=-0.02": "com=-0.005",
        "com=0.02": "com=0.005",
        "push=0.5": "push=0.25",
        "hands=0.5": "hands=0.25",
        "sole=0.02": "sole=0.005",
        "joints=1": "joints=0.12",
    }
    assert theirs == dict(zip(ALL, ALL, strict=True)) | changed


def test_the_command_keeps_and_shows_what_it_measured(monkeypatch, tmp_path, capsys):
    """One table, JSON, and exit code 0 though a bar is missed."""

    def measure(policy, setting, speeds, seeds, seed, progress, describe=None):
        progress(1.0)
        return [row(speed) for speed in speeds]

    def under(policy, setting, plans, robots, seed, progress):
        assert setting.randomize == judging.robots_that_differ("xbot_l")
        progress(1.0)
        return [{"schedule": plan.name, "survival": 0.5} for plan in plans]

    monkeypatch.setattr(measuring, "measure", measure)
    monkeypatch.setattr(scheduled, "measure", under)
    policy = policy_lib.load_policy("xbot_l_run")
    monkeypatch.setattr(policy_lib, "load_policy", lambda path: policy)
    out = tmp_path / "judged.json"
    assert judge.main(["xbot_l_run", "--json", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "speed at command 0 [m/s]" in shown  # rich takes it for a style unless told
    assert shown.count("yes") == 12 and shown.count("NO") == 1
    kept = json.loads(out.read_text())
    assert len(kept["bars"]) == 13 and kept["size"]["seeds"] == FULL.seeds
    assert len(kept["perturbed"]) == 16 and len(kept["schedules"]) == 4


def test_harsh_conditions_that_a_robot_lacks_are_named(monkeypatch, capsys):
    """The biped has no arms: nobody holds them, and they carry nothing."""

    def measure(policy, setting, speeds, seeds, seed, progress, describe=None):
        return [row(speed) for speed in speeds]

    monkeypatch.setattr(measuring, "measure", measure)
    monkeypatch.setattr(scheduled, "measure", lambda *args: [])
    debug = similar.preset("debug", BIPED)
    policy = policy_lib.Policy(debug, random_params(debug), curriculum.init(debug), 0)
    monkeypatch.setattr(policy_lib, "load_policy", lambda path: policy)
    for option, said in ([], "lacks it: hands "), (["--harsh"], "lacks it: hands, arms "):
        assert judge.main(["biped", *option]) == 0
        assert said in " ".join(capsys.readouterr().out.split())


def test_the_robots_of_the_schedules_differ_in_more_than_their_base():
    """Training draws from ranges that are at least as wide."""
    drawn, trained = judging.robots_that_differ("xbot_l"), config.preset("laptop").randomize
    assert drawn == ROBOTS
    for field in dataclasses.fields(drawn):
        if field.name.startswith(("push", "punch", "held", "ground")):
            continue
        mine, theirs = getattr(drawn, field.name), getattr(trained, field.name)
        assert theirs[0] <= mine[0] <= mine[1] <= theirs[1], field.name
    assert drawn.link_mass == (0.9, 1.1) and drawn.hand_mass == (0.0, 0.5)
    assert drawn.friction[0] < drawn.friction[1] and drawn.motor_strength == (0.9, 1.0)
    assert not drawn.push_seconds and drawn.punch == (0.0, 0.0) and not drawn.held_arms


def test_seeds_side_by_side(tmp_path, capsys):
    """One seed meets all bars, the median misses one by 5 %, the other seed by 100 %."""
    worse = {"a": {}, "b": {"lateral_std": 0.2}, "c": {"lateral_std": 0.105}}
    for name, changes in worse.items():
        results = good()
        results["speeds"][2] |= changes
        kept = [dataclasses.asdict(bar) for bar in bars(results)]
        (tmp_path / f"{name}.json").write_text(json.dumps({"bars": kept}))
    assert judge.main([str(tmp_path / f"{name}.json") for name in "bac"]) == 0
    shown = capsys.readouterr().out
    assert "median: c, which misses 1 of 13 bars" in shown
    assert shown.index(" a ") < shown.index(" c ") < shown.index(" b ")
    assert "0.105*" in shown and "0.2*" in shown
    for name in "ac":
        (tmp_path / f"in-{name}").mkdir()
        stored = (tmp_path / f"{name}.json").read_text()
        (tmp_path / f"in-{name}" / "same.json").write_text(stored)
    assert judge.main([str(tmp_path / f"in-{name}" / "same.json") for name in "ca"]) == 0
    assert "misses 1 of 13 bars" in capsys.readouterr().out  # the worse of the two is the median
    (tmp_path / "a.json").write_text("{}")
    assert judge.main([str(tmp_path / "a.json")]) == 2
    assert "no file of a finished judge --json" in capsys.readouterr().err


def test_files_of_other_conditions_are_not_comparable(tmp_path, capsys):
    stored = [dataclasses.asdict(bar) for bar in bars(good())]
    alike = {"robot": "xbot_l", "seed": 0, "size": {"seeds": 32, "seconds": 60.0}, "bars": stored}
    others = {
        "a": alike,
        "b": alike | {"policy": "another", "step": 9},
        "fewer": alike | {"size": {"seeds": 4, "seconds": 60.0}},
        "small": alike | {"robot": "biped", "seed": 1},
    }
    for name, kept in others.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(kept))

    def told(*names):
        assert judge.main([str(tmp_path / f"{name}.json") for name in names]) == 0
        return capsys.readouterr().out

    assert "Not comparable" not in told("a", "b")
    assert "the files differ in seeds." in told("a", "b", "fewer")
    assert "the files differ in robot, seed." in told("small", "a")


def test_what_lies_beyond_the_training_is_marked(monkeypatch):
    """The shipped policy was not trained with punches of 500 N. The table says so."""

    def measure(policy, setting, speeds, seeds, seed, progress, describe=None):
        return [row(speed, survival=0.5) for speed in speeds]

    monkeypatch.setattr(measuring, "measure", measure)
    policy = policy_lib.load_policy("xbot_l_run")
    names = "speeds", "perturbed", "harsh"
    parts = judging.measure(policy, FULL, 0, names, lambda name, share: None)
    assert parts["harsh"]["punch=500"]["rows"][0]["beyond"] == ["punch"]
    assert "beyond" not in parts["speeds"][1] and "beyond" not in parts["perturbed"]["payload=5"][0]
    found = {bar.name: bar for bar in bars(good() | parts)}
    assert found["share that does not fall, punch=500"].where == "0 m/s*"
    shown = judge.table(list(found.values()), "title")
    assert shown.caption == tables.BEYOND
    assert judge.table(bars(good()), "title").caption is None


def test_errors_are_one_line(capsys):
    for argv in (
        ["no-such-policy"],
        ["xbot_l_run", "--seconds", "2.5"],
        ["xbot_l_run", "other"],
        [],
    ):
        assert judge.main(argv) == 2
        assert capsys.readouterr().err.count("\n") == 1
