"""Who falls, and which of its numbers decides."""

import dataclasses
import json
import math
from pathlib import Path

import jax
import numpy as np
import pytest

from kslc_jax import falls, load_policy, randomize, robot
from kslc_jax.config import ConfigError, RandomizeConfig
from kslc_jax.evaluation import judging, schedules, suspects, trials


def test_chi_square_by_hand():
    """All of the lower half fell. Each quarter of 4 has 0 or 4 falls in place of 2:
    4 x 4 x 0.5^2 / (0.5 x 0.5) = 16, which is not enough. Of 20 robots it is 20."""
    assert suspects.suspects(np.repeat([True, False], 8), {"x": np.repeat([0.0, 1.0], 8)}) == []
    drawn = {"friction": np.repeat([0.0, 1.0], 10)}
    (found,) = suspects.suspects(np.repeat([True, False], 10), drawn)
    assert found.name == "friction" and found.chi_square == pytest.approx(20.0)
    assert found.shares == (1.0, 1.0, 0.0, 0.0)


def test_falls_at_both_ends_show():
    """Robots that fell have the same mean payload as the others."""
    payload = np.linspace(-5.0, 5.0, 64)
    (found,) = suspects.suspects(np.abs(payload) > 3.0, {"payload": payload})
    assert found.shares[0] == found.shares[3] > 0.7 and found.shares[1] == found.shares[2] == 0.0


def test_a_number_that_goes_with_nothing_is_not_named():
    rng = np.random.default_rng(1)
    drawn = {str(i): rng.uniform(size=128) for i in range(50)}
    assert suspects.suspects(np.arange(128) % 4 == 0, drawn) == []


def test_the_clearest_comes_first():
    rng = np.random.default_rng(0)
    friction, payload, other = rng.uniform(size=(3, 256))
    fell = (friction < 0.2) | ((payload > 0.7) & (friction < 0.7))
    drawn = {"other": other, "payload": payload, "friction": friction}
    found = suspects.suspects(fell, drawn)
    assert [suspect.name for suspect in found] == ["friction", "payload"]
    assert found[0].chi_square > found[1].chi_square
    assert found[0].shares[0] > 0.8 and found[0].shares[3] == 0.0


@pytest.mark.parametrize("count", [0, 3, 29, 32])
def test_too_few_on_one_side_tell_nothing(count):
    fell = np.arange(32) < count
    assert not suspects.told(fell)
    assert suspects.suspects(fell, {"friction": np.arange(32.0)}) == []


def drawn(config: RandomizeConfig, bot: robot.Robot, count: int = 4) -> randomize.Dynamics:
    """The numbers [count, ...] of some robots."""
    keys = jax.random.split(jax.random.key(0), count)
    return jax.vmap(lambda key: randomize.sample(config, bot, key))(keys)


def test_each_number_that_is_drawn_has_a_name():
    """A field of `Dynamics` that is missing in `NAMES` would never be suspected."""
    fields = {field.name for field in dataclasses.fields(randomize.Dynamics)}
    assert {*suspects.NAMES} == fields - {"ground", "noise"}
    dynamics = drawn(judging.robots_that_differ("xbot_l"), robot.load())
    found = suspects.numbers(dynamics, robot.load())
    assert len(found) == len(suspects.NAMES) + 4  # two positions have three axes
    np.testing.assert_array_equal(found["payload [kg]"], dynamics.base_mass)
    np.testing.assert_allclose(found["kp, factor"], dynamics.kp.mean(axis=1), rtol=1e-6)
    across = found["links' centres of mass [m], y"]
    np.testing.assert_allclose(across, dynamics.link_com[..., 1].mean(axis=1), rtol=1e-5)


def test_numbers_that_cannot_matter_are_left_out():
    """Not drawn; hands of a robot without arms; sole spheres at high fidelity, where feet are
    boxes."""
    narrow = RandomizeConfig(friction=(0.5, 0.5), base_mass=(-5.0, 5.0))
    assert list(suspects.numbers(drawn(narrow, robot.load()), robot.load())) == ["payload [kg]"]
    wide = judging.robots_that_differ("xbot_l")
    dynamics = drawn(wide, robot.load())
    train, high = (suspects.numbers(dynamics, robot.load(f)) for f in ("train", "high"))
    assert {*train} - {*high} == {"smaller soles [m]"}
    biped = robot.load(name=str(Path(__file__).parent / "data" / "biped.toml"))
    light = dataclasses.replace(wide, base_mass=(0.0, 0.1), hand_mass=(0.0, 0.1))
    assert "mass at the hands [kg]" not in suspects.numbers(drawn(light, biped), biped)


def test_the_usual_commands_before_a_fall():
    pairs = [([4.0, 0], [-0.3, 0]), ([3.9, 0], [-0.2, 0]), ([0, 0], [4.0, 0]), ([1.9, 0], [0, 0])]
    before = [{"from": a, "to": b} for a, b in pairs]
    assert suspects.usual(before, top=4.0) == [
        ("fast -> back", 2),
        ("stand -> fast", 1),
        ("slow -> stand", 1),
    ]


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
    """Of 32 robots that differ in their friction only."""
    before = [{"from": [4.0, 0.0], "to": [0.0, 0.0]}] * int(fell.sum())
    return suspects.report(fell, {"friction of the feet": np.arange(32.0)}, before, top=4.0)


def test_the_command_prints_and_writes_both_fidelities(monkeypatch, tmp_path, capsys):
    found = {"train": report(np.arange(32) < 16), "high": report(np.arange(32) < 1)}
    asked = []

    def measure(policy, setting, robots, seed, progress):
        asked.append((setting.schedule.name, setting.schedule.top, robots, seed))
        return found[setting.physics.fidelity]

    monkeypatch.setattr(falls, "measure", measure)
    out = tmp_path / "falls.json"
    assert falls.main(["xbot_l_run", "--top", "3", "--json", str(out)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    line = "50% of 32 │ fast -> stand (16) │ friction of the feet │ 100% │ 100% │ 0% │ 0%"
    assert f"train │ {line}" in said
    assert "high │ 3% of 32 │ fast -> stand (1) │ too few to tell │" in said
    assert asked == [("random", 3.0, 64, 0)] * 2
    kept = json.loads(out.read_text())
    assert (kept["policy"], kept["robot"], kept["top"]) == ("xbot_l_run", "XBot-L", 3.0)
    assert kept["fidelities"]["train"]["suspects"][0]["chi_square"] == pytest.approx(32.0)
    assert len(kept["fidelities"]["train"]["falls"]) == 16


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


def test_a_short_trial(policy):
    """More than half of the robots on ice fall within three seconds. Their friction is not named,
    because it is the same for all."""
    args = falls.Args(policy=Path("xbot_l_run"), robots=16, seconds=3.0)
    schedule = schedules.named("random", policy.config, 4.0)
    conditions = falls.setting(policy, args, schedule, "train")
    ice = dataclasses.replace(conditions.randomize, friction=(0.0, 0.0), ground_friction=0.05)
    found = falls.measure(policy, dataclasses.replace(conditions, randomize=ice), 16, seed=0)
    assert found["robots"] == 16 and found["fell"] == len(found["falls"]) / 16 > 0.5
    assert "friction of the feet" not in {suspect["name"] for suspect in found["suspects"]}
