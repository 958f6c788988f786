"""Who falls, and which of its numbers decides."""

import dataclasses
import json
import math

import jax
import numpy as np
import pytest

from kslc_jax import falls, load_policy, randomize, robot
from kslc_jax.config import ConfigError, RandomizeConfig
from kslc_jax.evaluation import judging, schedules, suspects, trials

FELL = np.repeat([True, False], 8)


def test_errors_by_hand():
    """Means 0 and 1, deviation 0.5, of 8 robots each: -1 / (0.5 sqrt(1/8 + 1/8)) = -4."""
    (found,) = suspects.suspects(FELL, {"friction": np.repeat([0.0, 1.0], 8)})
    assert found.name == "friction" and found.errors == pytest.approx(-4.0)
    assert found.shares == (1.0, 1.0, 0.0, 0.0)


def test_a_number_that_decides_nothing_is_not_named():
    """Equal means in both halves; and a difference of 2.8 standard errors, below 3."""
    same = np.tile([0.0, 1.0], 8)
    weak = np.repeat([0.0, 1.0], 8)
    weak[[0, 1, 8]] = 1.0, 1.0, 0.0
    wanted = (0.25 - 0.875) / (weak.std() * 0.5)
    assert -3.0 < wanted < -2.4
    assert suspects.suspects(FELL, {"same": same, "weak": weak}) == []


def test_the_clearest_comes_first():
    rng = np.random.default_rng(0)
    friction, payload, other = rng.uniform(size=(3, 256))
    fell = (friction < 0.2) | ((payload > 0.7) & (friction < 0.7))
    drawn = {"other": other, "payload": payload, "friction": friction}
    found = suspects.suspects(fell, drawn)
    assert [suspect.name for suspect in found] == ["friction", "payload"]
    assert found[0].errors < 0 < found[1].errors
    assert found[0].shares[0] > 0.8 and found[0].shares[3] == 0.0


@pytest.mark.parametrize("count", [0, 3, 13, 16])
def test_too_few_on_one_side_tell_nothing(count):
    fell = np.arange(16) < count
    assert suspects.suspects(fell, {"friction": np.arange(16.0)}) == []


def test_each_number_that_is_drawn_has_a_name():
    """A field of `Dynamics` that is missing in `NAMES` would never be suspected."""
    fields = {field.name for field in dataclasses.fields(randomize.Dynamics)}
    assert {*suspects.NAMES} == fields - {"ground"}
    keys = jax.random.split(jax.random.key(0), 4)
    config = judging.robots_that_differ("xbot_l")
    dynamics = jax.vmap(lambda key: randomize.sample(config, robot.load(), key))(keys)
    found = suspects.numbers(dynamics)
    assert {name.rsplit(", ", 1)[0] for name in found} >= {"trunk's centre of mass [m]", "kp"}
    assert len(found) == len(suspects.NAMES) + 4  # two positions have three axes
    np.testing.assert_array_equal(found["payload [kg]"], dynamics.base_mass)
    np.testing.assert_allclose(found["kp, factor"], dynamics.kp.mean(axis=1), rtol=1e-6)
    across = found["links' centres of mass [m], y"]
    np.testing.assert_allclose(across, dynamics.link_com[..., 1].mean(axis=1), rtol=1e-5)


def test_numbers_that_are_not_drawn_are_left_out():
    keys = jax.random.split(jax.random.key(0), 4)
    config = RandomizeConfig(friction=(0.5, 0.5), base_mass=(-5.0, 5.0))
    dynamics = jax.vmap(lambda key: randomize.sample(config, robot.load(), key))(keys)
    assert list(suspects.numbers(dynamics)) == ["payload [kg]"]


def test_the_usual_commands_before_a_fall():
    pairs = [([4.0, 0], [-0.3, 0]), ([3.9, 0], [0.2, 0]), ([0, 0], [4.0, 0])]
    before = [{"from": a, "to": b} for a, b in pairs]
    assert suspects.usual(before) == [("4 -> 0", 2), ("0 -> 4", 1)]


@pytest.fixture(scope="module")
def policy():
    return load_policy("xbot_l_run")


def test_the_robots_are_those_that_run(policy):
    """Their masses are those of the trace. At both fidelities they are the same."""
    schedule = schedules.named("random", policy.config, 2.0)
    found = []
    for fidelity in ("train", "high"):
        setting = trials.Setting(
            trials.engine(policy, fidelity),
            randomize=judging.robots_that_differ("xbot_l"),
            seconds=1.0,
            schedule=schedule,
        )
        found.append(trials.drawn(policy, setting, 4, seed=3))
        if fidelity == "train":
            (trace,) = trials.run(policy, setting, np.zeros((4, 3)), seed=3)
            weigh = jax.vmap(lambda d: randomize.total_mass(robot.load(), d))
            np.testing.assert_allclose(trace.mass[0], weigh(found[0]), rtol=1e-5)
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_array_equal(a, b)


def report(fell):
    """Of 16 robots that differ in their friction only."""
    dynamics = jax.vmap(lambda _: randomize.nominal(robot.load()))(np.arange(16))
    dynamics = dynamics.replace(friction=np.linspace(0.1, 2.0, 16))
    before = [{"from": [4.0, 0.0], "to": [0.0, 0.0]}] * int(fell.sum())
    return suspects.report(fell, dynamics, before)


def test_the_command_prints_and_writes_both_fidelities(monkeypatch, tmp_path, capsys):
    found = {"train": report(FELL), "high": report(~FELL & FELL)}
    asked = []

    def measure(policy, args, schedule, fidelity, progress):
        asked.append((schedule.name, schedule.top, args.robots))
        return found[fidelity]

    monkeypatch.setattr(falls, "measure", measure)
    out = tmp_path / "falls.json"
    assert falls.main(["xbot_l_run", "--top", "3", "--json", str(out)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "train │ 50% of 16 │ 4 -> 0 (8) │ friction of the feet │ 100% │ 100% │ 0% │ 0%" in said
    assert "high │ 0% of 16 │ │ - │" in said
    assert asked == [("random", 3.0, 64)] * 2
    kept = json.loads(out.read_text())
    assert kept["policy"] == "xbot_l_run" and kept["top"] == 3.0
    assert kept["fidelities"]["train"]["suspects"][0]["errors"] < -3.0
    assert len(kept["fidelities"]["train"]["falls"]) == 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": 15}, "robots"),
        ({"seconds": 1.0}, "seconds"),
        ({"seconds": math.nan}, "seconds"),
        ({"fidelity": ()}, "fidelity"),
        ({"fidelity": ("high", "high")}, "fidelity"),
        ({"top": 0.0}, "top"),
        ({"seed": -1}, "seed"),
    ],
)
def test_bad_input(changes, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        falls.Args(policy=tmp_path, **changes)


@pytest.mark.slow(reason="16 robots for 3 s at high fidelity")
def test_a_short_trial(policy, tmp_path):
    """A robot of an untrained length of time: nobody falls, and nothing is told."""
    out = tmp_path / "falls.json"
    few = ["--robots", "16", "--seconds", "3", "--json", str(out)]
    assert falls.main(["xbot_l_run", *few]) == 0
    kept = json.loads(out.read_text())["fidelities"]
    assert {*kept} == {"train", "high"} and all(of["robots"] == 16 for of in kept.values())
