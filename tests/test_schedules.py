"""Commands that change: what is asked, when, and the numbers drawn from the reaction."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from states import still_policy

from kslc_jax import curriculum
from kslc_jax.config import ConfigError, HighFidelity, PhysicsConfig, preset
from kslc_jax.evaluation import reaction, scheduled, schedules, tables, trained, trials
from kslc_jax.evaluation.perturbations import Variation
from kslc_jax.policy import Policy

DT = 0.01
CONFIG = preset("laptop")


def played(schedule, seconds, yaw=0.0, robots=1, move=None):
    """Number, velocity and heading of the legs of robots that stand at `yaw`, or move by
    `move(leg)` [2, m] a step."""

    def step(carry, _):
        leg, position, key = carry
        leg = schedules.update(schedule, CONFIG.command, leg, key, yaw, position, DT)
        position = position + (move(leg) if move else 0.0)
        return (leg, position, key), (leg.number, leg.velocity, leg.heading)

    def one(key):
        start = schedules.before_start(yaw), jnp.zeros(2), key
        return jax.lax.scan(step, start, None, length=round(seconds / DT))[1]

    out = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), robots))
    return [np.asarray(x) for x in out]


def test_stop_alternates_between_the_top_speed_and_rest():
    schedule = schedules.named("stop", CONFIG, 4.0)
    number, velocity, heading = played(schedule, 14.0, yaw=0.5)
    expected = np.r_[np.full(500, 4.0), np.zeros(400), np.full(500, 4.0)]
    np.testing.assert_array_equal(velocity[0, :, 0], expected)
    np.testing.assert_array_equal(number[0], np.repeat([0, 1, 2], [500, 400, 500]))
    np.testing.assert_allclose(heading, 0.5)
    assert not velocity[..., 1:].any()


def test_reverse_goes_backwards_and_top_limits_it():
    schedule = schedules.named("reverse", CONFIG, 4.0, top=2.0)
    velocity = played(schedule, 9.0)[1][0, :, 0]
    np.testing.assert_allclose([velocity[0], velocity[-1]], [2.0, CONFIG.curriculum.v_min])


@pytest.mark.parametrize(("name", "shortest"), [("random", 1.0), ("jitter", 0.3)])
def test_random_commands_stay_in_the_trained_box(name, shortest):
    """With stops and reversals from the top, each robot its own."""
    schedule = schedules.named(name, CONFIG, 4.0)
    number, velocity, _ = played(schedule, 60.0, robots=16)
    low, (right, left) = CONFIG.curriculum.v_min, CONFIG.command.vy
    assert velocity[..., 0].min() >= low and velocity[..., 0].max() == 4.0
    assert velocity[..., 1].min() >= right and velocity[..., 1].max() <= left
    lengths = np.concatenate([np.bincount(n)[:-1] for n in number]) * DT
    assert shortest - DT <= lengths.min() < shortest + 0.2 and 3.8 < lengths.max() <= 4.0 + DT
    after_top = [v[1:][np.diff(n) > 0][:, 0] for n, v in zip(number, velocity, strict=True)]
    before = [v[:-1][np.diff(n) > 0][:, 0] for n, v in zip(number, velocity, strict=True)]
    braked = np.concatenate(after_top)[np.concatenate(before) == 4.0]
    assert set(np.round(braked, 3)) == {0.0, np.float32(np.round(low, 3))}
    assert 0.5 < np.mean(braked == 0.0) < 0.85
    assert len({n[-1] for n in number}) > 3


def test_box_draws_every_four_seconds():
    number, velocity, _ = played(schedules.named("box", CONFIG, 4.0), 60.0, robots=16)
    np.testing.assert_array_equal(number[:, 200::400], np.tile(np.arange(15), (16, 1)))
    assert velocity[..., 0].max() < 4.0  # a drawn one is never the top itself


def test_turns_ask_for_what_training_asks():
    """Pi of heading error at rest, shrinking to nothing at narrow_speed, times the gain."""
    rates = {s.vx: s.yaw_rate for s in schedules.named("turns", CONFIG, 4.0).steps if s.yaw_rate}
    assert rates[1.0] == -1.0  # the largest: 0.5 * 3/4 pi is more
    assert rates[3.0] == pytest.approx(-0.5 * np.pi / 4)


def test_tour_slows_down_reaches_its_points_and_goes_on():
    """A robot that does at once what it is told: walks where it is asked to head."""
    schedule = schedules.named("tour", CONFIG, 3.0)

    def walk(leg):
        return DT * leg.velocity[0] * jnp.stack([jnp.cos(leg.heading), jnp.sin(leg.heading)])

    number, velocity, _ = played(schedule, 60.0, robots=4, move=walk)
    assert number[:, -1].min() >= 4
    speed = velocity[..., 0]
    assert 2.9 < speed.max() <= 3.0 and speed.min() >= schedules.CRAWL - 1e-6


def test_a_file_of_ones_own(tmp_path):
    path = tmp_path / "mine.json"
    steps = [
        {"seconds": 1, "vx": 2, "yaw_rate": 0.5},
        {"seconds": 1, "vx": 5, "vy": 0.1},
        {"seconds": 1, "vx": 0, "heading": 1.5},
    ]
    path.write_text(json.dumps(steps))
    schedule = schedules.named(str(path), CONFIG, 4.0, top=3.0)
    _, velocity, heading = played(schedule, 4.0, yaw=0.25)
    np.testing.assert_allclose(velocity[0, 50], [2.0, 0.0, 0.5])
    np.testing.assert_allclose(velocity[0, 150], [3.0, 0.1, 0.0], rtol=1e-6)
    np.testing.assert_allclose(heading[0, [150, 250, 350]], [0.25, 1.5, 1.5])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[", "is not JSON"),
        ("{}", "is no list of steps"),
        ("[]", "is no list of steps"),
        ("[1]", "step 0 .* needs seconds and vx"),
        ('[{"vx": 1}]', "step 0 .* needs seconds and vx"),
        ('[{"seconds": 1, "vx": 1, "speed": 2}]', "step 0 .* unknown name 'speed'"),
        ('[{"seconds": 1, "vx": 1}, {"seconds": 0, "vx": 1}]', "step 1 .* seconds must be above 0"),
        ('[{"seconds": 1, "vx": NaN}]', "vx must be a finite number"),
        ('[{"seconds": 1, "vx": "fast"}]', "vx must be a finite number"),
        ('[{"seconds": 1, "vx": 1, "heading": null}]', "heading must be a finite number"),
        ('[{"seconds": 1, "vx": 1' + 400 * "0" + "}]", "vx must be a finite number"),
        ('[{"seconds": 1, "vx": 1, "yaw_rate": 1, "heading": 0}]', "both"),
    ],
)
def test_a_file_that_is_no_schedule_is_told_in_one_line(tmp_path, text, says):
    path = tmp_path / "mine.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says) as error:
        schedules.named(str(path), CONFIG, 4.0)
    assert "\n" not in str(error.value)


def test_a_folder_is_no_schedule(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot read .*: Is a directory"):
        schedules.named(str(tmp_path), CONFIG, 4.0)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"no file 'stopp' .*stop, reverse"):
        schedules.named("stopp", CONFIG, 4.0)


# ------------------------------------------------------------------------------------------ trials


@pytest.fixture(scope="module")
def still():
    return still_policy(preset("debug"))


@pytest.mark.slow(reason="compiles a trial; test_viewer.py has another with a schedule")
def test_a_trial_follows_its_schedule_from_any_heading(still):
    """Both in one program: the number of programs is what a sweep waits for."""
    schedule = schedules.Schedule(
        "mine", 1.0, steps=(schedules.Step(0.2, 1.0), schedules.Step(9, 0.5))
    )
    setting = trials.Setting(PhysicsConfig(engine="mujoco"), seconds=1.0, schedule=schedule)
    for heading in (np.pi / 2, np.pi):
        turned = dataclasses.replace(setting, heading=heading)
        trace = next(iter(trials.run(still, turned, np.zeros((2, 3)), chunk=0.3)))
        np.testing.assert_array_equal(trace.leg[:, 0], np.repeat([0, 1], [20, 10]))
        np.testing.assert_array_equal(trace.command[:, 1, 0], np.repeat([1.0, 0.5], [20, 10]))
        off = (trace.euler[..., 2] - heading + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(off).max() < 0.1


# ---------------------------------------------------------------------------------------- reaction


def synthetic(velocity, command, leg, alive=None):
    """The trace of one robot from its forward speed and its commands [T]."""
    steps = len(velocity)
    zeros = np.zeros((steps, 1, 3))
    position = np.zeros((steps, 1, 23))
    position[:, 0, 0] = np.cumsum(velocity) * DT
    blank = dict.fromkeys(trials.Trace.__dataclass_fields__, zeros)
    named = {
        "alive": np.ones((steps, 1), bool) if alive is None else alive[:, None],
        "qpos": position,
        "linvel": zeros + velocity[:, None, None] * [1, 0, 0],
        "command": zeros + command[:, None, None] * [1, 0, 0],
        "leg": leg[:, None],
    }
    return trials.Trace(**(blank | named))


def test_reaction_to_a_stop_by_hand():
    """From 2 m/s to rest in 1 s: 1 m. With s seconds of braking left, the average over 0.5 s is
    (s + 0.25)^2 / 0.5, so that it falls below 0.15 m/s after 0.976 s."""
    brake = np.clip(2.0 - 2.0 * np.arange(400) * DT, 0.0, None)
    velocity = np.r_[np.full(500, 2.0), brake]
    leg = np.repeat([0, 1], [500, 400])
    found = reaction.summary(synthetic(velocity, 2.0 * (leg == 0), leg), DT)
    assert found["changes"] == 1 and found["survival"] == 1.0 and found["stopped"] == 1.0
    assert found["change_error"] == pytest.approx(0.5, abs=0.02)  # 1 m/s over 1 s of 2 s
    when = 1.0 - (np.sqrt(0.15 * 0.5) - 0.25)
    assert found["stop_seconds"] == pytest.approx(when, abs=0.05)
    assert found["stop_metres"] == pytest.approx(1.0, abs=0.03)
    assert found["settle_seconds"] == pytest.approx(when, abs=0.1) and found["settled"] == 1.0
    assert found["drift"] < 0.02


def test_a_fall_counts_in_survival_and_is_told():
    leg = np.repeat([0, 1, 2], [300, 300, 300])
    command = np.array([3.0, 0.0, 1.0])[leg]
    alive = np.arange(900) < 450
    trace = synthetic(command, command, leg, alive)
    found = reaction.summary(trace, DT)
    assert found["survival"] == 0.0 and found["changes"] == 0
    assert found["seconds_to_fall"] == pytest.approx(4.5)
    (fall,) = reaction.falls(trace, DT)
    assert fall["after"] == pytest.approx(1.5)
    assert (fall["from"], fall["to"]) == ([3.0, 0.0], [0.0, 0.0])
    shown = reaction.series(trace, DT)["forward"][0]
    assert shown[44] is not None and shown[45:] == [None] * 45


@pytest.mark.parametrize(("lived", "changes"), [(150, 0), (350, 0), (750, 1)])
def test_the_leg_of_a_fall_is_no_change(lived, changes):
    leg = np.repeat([0, 1, 2], [300, 300, 300])
    trace = synthetic(1.0 * leg, 1.0 * leg, leg, np.arange(900) < lived)
    found = reaction.summary(trace, DT)
    assert found["changes"] == changes and ("settled" in found) == bool(changes)


def test_a_tour_counts_its_way_points():
    """Two are reached in 10 s each. The third is given up. The fourth leg has not ended."""
    leg = np.repeat([0, 1, 2, 3], [1000, 1000, round(schedules.PATIENCE / DT), 1000])
    speed = np.ones(len(leg))
    found = reaction.tour(synthetic(speed, speed, leg), DT)
    assert found["way_points"] == pytest.approx(2 / 1.5) and found["given_up"] == 1.0
    assert found["survival"] == 1.0 and found["forward_mean"] == pytest.approx(1.0)
    fallen = reaction.tour(synthetic(speed, speed, leg, np.arange(len(leg)) < 1500), DT)
    assert fallen["way_points"] == pytest.approx(1 / 0.25) and fallen["given_up"] == 0.0
    assert fallen["seconds_to_fall"] == pytest.approx(15.0)


def test_each_schedule_is_a_row_with_its_own_metrics(still, monkeypatch):
    """Of a stand-in for the trials: a fall after 15 s, and a robot that does as it is told."""
    leg = np.repeat([0, 1], [1000, 1000])

    def run(policy, setting, commanded, seed):
        tour = setting.schedule.tour
        yield synthetic(1.0 * leg, 1.0 * leg, leg, np.arange(2000) < (1500 if tour else 2000))

    monkeypatch.setattr(trials, "run", run)
    setting = trials.Setting(PhysicsConfig(engine="mujoco"), seconds=20.0)
    plans = [schedules.named(name, preset("debug"), 1.0) for name in ("stop", "tour")]
    told = []
    stop, tour = scheduled.measure(still, setting, plans, 1, progress=told.append)
    assert told == pytest.approx([0.025, 0.525])  # one second of 20, of each of two
    assert stop["schedule"] == "stop" and stop["top"] == 1.0 and stop["changes"] == 1
    assert stop["falls"] == [] and len(stop["series"]["forward"][0]) == 200
    assert tour["way_points"] == pytest.approx(4.0) and "changes" not in tour
    assert [fall["seconds"] for fall in tour["falls"]] == [15.0]

    shown = scheduled.table({"nominal": [stop, tour]}, "title")
    columns = {str(column.header): list(column.cells) for column in shown.columns}
    assert columns["schedule"] == ["stop*", "tour*"] and shown.caption == tables.BEYOND
    assert columns["survived"] == ["100%", "0%"] and columns["fell at \\[s]"] == ["-", "15"]
    assert columns["changes"] == ["1.0", "-"] and columns["way-points a minute"] == ["-", "4.0"]
    assert "within \\[m]" not in columns  # neither has stops


# ----------------------------------------------------------------------------------------- trained


def test_what_lies_beyond_the_training_is_named(still):
    policy = Policy(CONFIG, None, curriculum.init(CONFIG), 0)
    v_max = float(policy.curriculum.v_max)
    plain = trials.Setting(HighFidelity())

    def reasons(command=(0.0, 0.0, 0.0), **changes):
        setting = dataclasses.replace(plain, **changes)
        return trained.beyond(policy, setting, command).get("beyond", [])

    def turns(vx, heading):
        steps = schedules.Step(9.0, vx, heading=0.0), schedules.Step(9.0, vx, heading=heading)
        return schedules.Schedule("turns", top=vx, steps=steps)

    def robots(**changes):
        return reasons(randomize=dataclasses.replace(trials.NOMINAL, **changes))

    assert reasons() == [] and reasons((v_max, 0.26, 1.0)) == []
    # At v_max, 0.5 m/s, vy has 1 - 0.5 / 4 of its range: 0.2625 m/s.
    assert reasons((v_max, 0.27, 1.0)) == ["sideways"] and reasons((0.0, 0.3, 1.0)) == []
    assert reasons((v_max + 0.5, 0.4, 1.5)) == ["speed", "sideways", "turn"]
    assert robots(base_mass=(5.0, 5.0)) == [] and robots(base_mass=(8.0, 8.0)) == ["base_mass"]
    assert robots(friction=(0.3, 0.3), ground_friction=0.3) == ["friction"]
    assert robots(push_seconds=4.0, push_velocity=0.5) == ["push"]
    assert robots(link_mass=(0.9, 1.1)) == [] and robots(link_mass=(0.8, 1.2)) == ["link_mass"]
    assert reasons(variation=Variation(hands=0.5)) == []
    assert reasons(variation=Variation(hands=0.6, sole=0.01)) == ["hands", "sole"]
    assert robots(punch=(300.0, 300.0), held_arms=1.0) == ["punch", "arms"]
    assert robots(punch=(100.0, 100.0)) == []
    assert reasons(latency=1, imu_offset=(0.1, 0.0)) == ["latency", "imu"]
    assert reasons(schedule=turns(0.5, 3.0)) == [] and reasons(schedule=turns(0.5, 0.2)) == []
    # At v_max the yaw rate is at most 0.5 (1 - 0.5 / 4) pi = 1.37; it is cut at 1. With a cut at 2:
    wide = dataclasses.replace(CONFIG.command, max_yaw_rate=2.0)
    policy = Policy(dataclasses.replace(CONFIG, command=wide), None, policy.curriculum, 0)
    assert reasons(schedule=turns(0.5, 3.0)) == ["turn"] and reasons(schedule=turns(0.0, 3.0)) == []
    assert reasons(schedule=turns(0.5, 3.0), heading=3.0) == ["turn"]  # from the second round on
    policy = Policy(CONFIG, None, policy.curriculum, 0)
    stop = schedules.named("stop", CONFIG, v_max)
    jitter = schedules.named("jitter", CONFIG, v_max)
    assert reasons(schedule=stop) == [] and reasons(schedule=jitter) == ["pace"]
    assert reasons(schedule=dataclasses.replace(stop, steps=(schedules.Step(9.0, 9.0),))) == [
        "speed"
    ]
