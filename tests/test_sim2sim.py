"""Sim-to-sim: perturbations, latency and sensor errors do what they are called."""

import dataclasses
import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import slow
import tyro
from states import XBOT, random_params

import kslc_jax.evaluation
from kslc_jax import curriculum, env, randomize, robot, sim2sim
from kslc_jax import policy as policy_lib
from kslc_jax.config import ConfigError, HighFidelity, PhysicsConfig, preset
from kslc_jax.evaluation import gait_metrics, measure, perturbations, trials


@pytest.fixture(scope="module")
def random_policy():
    """An untrained policy with sizeable actions."""
    config = preset("debug")
    return policy_lib.Policy(config, random_params(config), curriculum.init(config), 0)


@pytest.fixture
def frozen(monkeypatch):
    """An environment that only shows the action it was sent, as its torque, and ends."""

    def step(config, state, action, key, curriculum, simulate):
        shown = state.replace(physics=state.physics.replace(torque=action))
        fell = jax.numpy.ones((), bool)
        return shown, env.Outcome(**dict.fromkeys(env.Outcome.__dataclass_fields__, fell))

    monkeypatch.setattr(env, "step", step)


def actions(policy, **conditions):
    """Actions sent [T, 16], and the history [K, 59] that the first one answered."""
    setting = trials.Setting(PhysicsConfig(engine="mujoco"), seconds=0.03, **conditions)
    config = trials.trial_config(policy.config, setting, 1)
    key = jax.random.split(jax.random.split(jax.random.key(0))[0], 1)[0]
    history = jax.jit(lambda k: env.reset(config, k, policy.curriculum).history)(key)
    trace = next(iter(trials.run(policy, setting, np.zeros((1, 3)), chunk=0.03)))
    return trace.torque[:, 0], history


def dynamics(condition):
    """The dynamics and the contact friction under a condition."""
    conditions = sim2sim.setting(sim2sim.Args("x"), HighFidelity(), condition).randomize
    drawn = randomize.sample(conditions, XBOT, jax.random.key(0))
    fields = randomize.model_fields(robot.load("high"), drawn, conditions.ground_friction)
    return drawn, fields["geom_friction"][robot.load("high").foot_geom_ids, 0]


def test_the_nominal_robot_is_the_described_one_at_high_fidelity():
    setting = sim2sim.setting(sim2sim.Args("x"), HighFidelity(), "nominal")
    assert setting.physics == HighFidelity() and setting.randomize == trials.NOMINAL
    assert setting.seconds == 60.0 and not setting.noise and not setting.latency
    drawn, friction = dynamics("nominal")
    np.testing.assert_allclose(friction, 1.0)
    np.testing.assert_array_equal(drawn.kp, 1.0)


@pytest.mark.parametrize("mu", [0.3, 1.5])
def test_friction_is_that_of_the_contact(mu):
    """Foot and ground are averaged; the named value is what comes out."""
    np.testing.assert_allclose(dynamics(f"friction={mu}")[1], mu, rtol=1e-6)


def test_perturbations_reach_the_robot():
    assert dynamics("payload=-5")[0].base_mass == -5.0
    np.testing.assert_allclose(dynamics("com=-0.02")[0].base_com, -0.02, rtol=1e-6)
    gains = dynamics("gains=0.85")[0]
    np.testing.assert_allclose(np.r_[gains.kp, gains.kd], 0.85, rtol=1e-6)
    np.testing.assert_allclose(dynamics("strength=0.9")[0].motor_strength, 0.9, rtol=1e-6)
    push = sim2sim.setting(sim2sim.Args("x"), HighFidelity(), "push=0.5").randomize
    assert (push.push_seconds, push.push_velocity, push.push_angular) == (4.0, 0.5, 0.0)
    assert sim2sim.setting(sim2sim.Args("x"), HighFidelity(), "imu=0.03").imu_offset == (0.03, 0.03)


@pytest.mark.parametrize(
    ("condition", "kg"),
    [("payload=-5", -5), *slow.cases("compiles again", ("nominal", 0), ("payload=5", 5))],
)
def test_the_payload_is_in_the_mass_that_the_cost_of_transport_divides_by(
    random_policy, frozen, condition, kg
):
    """The trace's mass is that of the model which the engine steps: 53.036 kg and the payload."""
    setting = dataclasses.replace(
        sim2sim.setting(sim2sim.Args("x"), HighFidelity(), condition), seconds=0.03
    )
    trace = next(iter(trials.run(random_policy, setting, np.zeros((2, 3)), chunk=0.03)))
    np.testing.assert_allclose(trace.mass, np.full((3, 2), 53.036 + kg), atol=1e-3)
    xbot = robot.load("high")
    fields = randomize.model_fields(xbot, dynamics(condition)[0], 1.0)
    assert float(fields["body_mass"].sum()) == pytest.approx(trace.mass[0, 0], abs=1e-4)


def resolved(**options):
    """The conditions of the command line, with those of XBot-L in place of "all"."""
    args = sim2sim.Args("x", **options)
    args = dataclasses.replace(args, perturb=sim2sim.named(args, robot.load("high")))
    return args.conditions


def test_all_runs_sixteen_perturbations_after_the_nominal_robot():
    conditions = resolved(perturb=("all",))
    more = resolved(perturb=("all", "friction=0.2", "payload=5"))
    assert more == (*conditions, "friction=0.2")  # payload=5 is one of the sixteen
    assert conditions[0] == "nominal" and len(set(conditions)) == 17


def test_drake_runs_what_it_can():
    """Robots whose hands, soles or joints differ need MuJoCo."""
    conditions = resolved(engine="drake", perturb=("all",))
    assert len(conditions) == 14 and "hands=0.5" not in conditions
    for what in ({"perturb": ("hands=0.5",)}, {"punch": 100.0}):
        with pytest.raises(ConfigError, match="need --engine mujoco"):
            sim2sim.Args("x", engine="drake", **what)


def test_headings_are_conditions():
    """The first one is that of all others."""
    args = sim2sim.Args("x", heading=(np.pi, 0.5), perturb=("payload=5",))
    assert args.conditions == ("nominal", "heading=0.5", "payload=5")
    assert [sim2sim.setting(args, HighFidelity(), c).heading for c in args.conditions] == [
        np.pi,
        0.5,
        np.pi,
    ]


@pytest.mark.parametrize(
    "name", ["wind=3", "payload", "payload=heavy", "all=1", "links=2", "sole=0.2"]
)
def test_perturbations_that_cannot_be_are_refused(name):
    with pytest.raises(ConfigError):
        sim2sim.Args("x", perturb=(name,))


def test_a_payload_takes_no_more_than_the_trunk_weighs(capsys):
    """It is refused before any trial."""
    assert sim2sim.main(["xbot_l_run", "--perturb", "payload=5", "payload=-30"]) == 2
    said = capsys.readouterr()
    assert "randomize.base_mass: -30 kg leave -8.9 of the trunk's 21.1 kg" in said.err
    assert "payload" not in said.out


@pytest.mark.parametrize("steps", [2, *slow.cases("compiles, like two steps", 1)])
def test_latency_sends_an_action_of_some_steps_before(random_policy, frozen, steps):
    """In the first steps there is none, which asks for the default pose."""
    sent, history = actions(random_policy, latency=steps)
    decided = random_policy.act_on(history)
    assert np.abs(decided).max() > 0.01
    late = [[0.0 * decided, decided][i >= steps] for i in range(3)]
    np.testing.assert_allclose(sent, late, atol=1e-6)


@pytest.mark.parametrize(
    ("words", "steps"), [("", 0), ("--latency", 1), ("--latency --noise", 1), ("--latency 3", 3)]
)
def test_latency_alone_is_one_step(words, steps):
    argv = sim2sim.with_latency(["p", *words.split()])
    assert tyro.cli(sim2sim.Args, args=argv).latency == steps
    assert tyro.cli(sim2sim.Args, args=sim2sim.with_latency([*words.split(), "p"])).policy.name


def test_imu_offset_is_an_error_of_roll_and_pitch(random_policy, frozen):
    """By hand: clock 2, command 3, joints 3 x 16, rates 3, so roll and pitch are 56 and 57."""
    sent, history = actions(random_policy, imu_offset=(0.3, 0.2))
    seen = history.at[:, 56].add(0.3).at[:, 57].add(0.2)
    np.testing.assert_allclose(sent[0], random_policy.act_on(seen), atol=1e-6)
    assert np.abs(sent[0] - random_policy.act_on(history)).max() > 1e-3


def test_a_sweep_too_large_for_memory_goes_speed_by_speed(random_policy, frozen, monkeypatch):
    monkeypatch.setattr(measure, "MOST_SAMPLES", 1)
    shares = []
    setting = trials.Setting(PhysicsConfig(engine="mujoco"), seconds=3.0)
    rows = measure.measure(random_policy, setting, (0.0, 1.0), 1, progress=shares.append)
    assert [row["command"] for row in rows] == [0.0, 1.0]
    np.testing.assert_allclose(shares, np.arange(1, 7) / 6)


def test_report(random_policy, monkeypatch, tmp_path, capsys):
    """One table per condition, a summary, and JSON that holds every row."""

    def fake(policy, setting, speeds, seeds, seed, progress, vy, yaw_rate):
        assert (vy, yaw_rate) == (0.0, 0.0)
        progress(1.0)
        extra = setting.randomize.base_mass[0]
        return [{"command": v, "survival": 0.5, "forward_mean": v - extra} for v in speeds]

    monkeypatch.setattr(measure, "measure", fake)
    monkeypatch.setattr(policy_lib, "load_policy", lambda path: random_policy)
    out = tmp_path / "deep" / "out.json"
    argv = ["p", "--speeds", "1", "2", "--perturb", "payload=0.25", "--latency", "--json", str(out)]
    assert sim2sim.main(argv) == 0
    shown = capsys.readouterr().out
    assert shown.count("payload=0.25") == 2 and "50% 1.75" in shown and "vy [m/s]" not in shown
    kept = json.loads(out.read_text())
    assert kept["latency"] and not kept["noise"] and kept["engine"] == "mujoco"
    assert [r["forward_mean"] for r in kept["conditions"]["payload=0.25"]] == [0.75, 1.75]


def test_a_side_step_and_a_turn_are_commanded_with_every_speed(random_policy, monkeypatch, capsys):
    """And shown: what was asked for, and what came of it."""
    asked = []

    def run(policy, setting, velocities, seed):
        asked.append(velocities)
        yield velocities

    monkeypatch.setattr(trials, "run", run)
    monkeypatch.setattr(trials, "join", lambda pieces: pieces[0])
    found = {"lateral_mean": 0.29, "yaw_rate_mean": -0.98}
    monkeypatch.setattr(gait_metrics, "summary", lambda trace, speed, robot, dt: found)
    monkeypatch.setattr(policy_lib, "load_policy", lambda path: random_policy)
    argv = ["p", "--speeds", "0", "0.5", "--seeds", "2", "--sideways", "0.3", "--turn", "-1"]
    assert sim2sim.main(argv) == 0
    expected = [[0, 0.3, -1], [0, 0.3, -1], [0.5, 0.3, -1], [0.5, 0.3, -1]]
    np.testing.assert_array_equal(asked, [expected])
    shown = capsys.readouterr().out
    assert "0.3 m/s sideways and -1 rad/s" in shown and "0.29" in shown and "-0.98" in shown


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["no-such-policy"], "no run, checkpoint or shipped policy"),
        (["x", "--seconds", "2"], "seconds must be a whole number from 3"),
        (["x", "--turn", "nan"], "sideways and turn must be finite"),
        (["x", "--seeds", "0"], "seeds must be positive"),
        (["x", "--latency", "99"], "latency must lie in 0 to 50"),
        (["x", "--punch", "-1"], "punch must be a force"),
        (["x", "--top", "0"], "top must be a positive speed"),
        (["x", "--top", "2"], "top is the fastest command of a schedule"),
        (["x", "--schedule", "stop", "--speeds", "1"], "a schedule has its own commands"),
        (["x", "--schedule", "stop", "--turn", "1"], "a schedule has its own commands"),
        (["x", "--perturb", "wind=3"], "cannot read 'wind=3'"),
    ],
)
def test_errors_are_one_line(argv, says, capsys):
    assert sim2sim.main(argv) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1 and err[0].startswith("error: ") and says in err[0]


def test_a_missing_engine_says_how_to_get_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "kslc_jax.evaluation.drake", None)
    monkeypatch.delattr(kslc_jax.evaluation, "drake", raising=False)
    assert sim2sim.main(["x", "--engine", "drake"]) == 2
    assert "pip install 'kslc_jax[drake]'" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["noise", "latency"])
def test_a_condition_that_is_asked_for_is_set(name):
    setting = sim2sim.setting(sim2sim.Args(Path("x"), **{name: True}), HighFidelity(), "payload=5")
    assert (setting.noise, setting.latency) == (name == "noise", name == "latency")


def test_the_json_names_a_schedule_not_its_path(random_policy, monkeypatch, tmp_path):
    file = tmp_path / "hill.json"
    file.write_text('[{"seconds": 3, "vx": 0.5}]')
    monkeypatch.setattr(policy_lib, "load_policy", lambda path: random_policy)
    monkeypatch.setattr(sim2sim, "sweeps", lambda args, policy, progress: {"nominal": []})
    monkeypatch.setattr(sim2sim, "_show", lambda *args: None)
    out = tmp_path / "out.json"
    assert sim2sim.main(["p", "--schedule", str(file), "stop", "--json", str(out)]) == 0
    assert json.loads(out.read_text())["schedule"] == ["hill", "stop"]
    assert str(tmp_path) not in out.read_text()


def test_what_a_robot_lacks_is_left_out_and_named():
    tried = [condition for condition in perturbations.ALL if not condition.startswith("hands")]
    said = perturbations.left_out(perturbations.ALL, tried)
    assert said == "left out, because robot or engine lacks it: hands"
    assert perturbations.left_out((), tried) == "" == perturbations.left_out(tried, tried)
