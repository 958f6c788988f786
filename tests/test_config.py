"""The numbers of the paper, presets and ablations, storage, and errors that name the field."""

import dataclasses
import json
import operator
import subprocess
import sys
from typing import Any

import pytest
from states import XBOT

from kslc_jax import config as config_lib
from kslc_jax import observations, train
from kslc_jax.config import (
    ABLATIONS,
    PRESETS,
    Config,
    ConfigError,
    HighFidelity,
    RandomizeConfig,
    from_dict,
    preset,
    to_dict,
)

PAPER = preset("paper")
LAPTOP = preset("laptop")
BASELINE = preset("baseline")


def changes(a: Any, b: Any, where: str = "") -> dict[str, tuple[Any, Any]]:
    """The fields that differ, by dotted name."""
    out = {}
    for f in dataclasses.fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if dataclasses.is_dataclass(x):
            out |= changes(x, y, f"{where}{f.name}.")
        elif x != y:
            out[f"{where}{f.name}"] = (x, y)
    return out


# -------------------------------------------------------------------------- the paper, Humanoid-Gym


def test_table_1():
    assert PAPER.env.num_envs == 4096
    assert PAPER.minibatch_size == 61_440
    assert PAPER.ppo.gamma == 0.994
    assert PAPER.ppo.lam == 0.9
    assert PAPER.ppo.entropy_coef == 0.001
    assert abs(PAPER.rewards.weights.angular_momentum) == 0.05
    assert PAPER.ppo.learning_rate == 1e-5
    assert PAPER.env.frames == 15
    assert PAPER.env.privileged_frames == 3
    assert observations.actor_width(XBOT) == 59
    assert observations.critic_width(XBOT) == 89


def test_table_2_and_the_action_space():
    assert XBOT.count == 16
    assert PAPER.env.arms == "free"


def test_equations_2_to_8():
    r = PAPER.rewards
    assert r.weights.angular_momentum == 0.05  # Eq. 2
    assert (r.weights.base_height, r.weights.feet_clearance, r.weights.joint_pos) == (0.2, 1.0, 1.6)
    assert (r.base_height_kernel, r.base_height_drop) == (100.0, 0.05)  # Eq. 6
    assert (r.joint_pos_kernel, r.joint_pos_penalty, r.joint_pos_clip) == (2.0, 0.2, 0.5)  # Eq. 8
    assert r.velocity_rewards and r.only_positive
    # Our numbers, where Eq. 4 and 7 give none.
    assert (r.momentum_scale, r.momentum_floor) == (5.0, -20.0)
    assert (r.clearance_speed_gain, r.clearance_width) == (1.0, 0.01)


def test_equations_9_and_10():
    c = PAPER.curriculum
    assert c.velocity and c.cycle
    assert (c.threshold, c.v_step, c.v_limit) == (0.8, 0.5, 3.5)
    assert (c.cycle_factor, c.cycle_min) == (0.95, 0.48)
    # Beyond the paper.
    assert (c.v_min, c.v_start) == (-0.3, 0.5)
    assert (c.fast_share, c.fast_threshold, c.min_episode_steps) == (0.6, 0.7, 1000.0)
    assert (c.smoothing, c.min_updates) == (0.95, 40)


def test_what_the_paper_leaves_to_humanoid_gym():
    p = PAPER.ppo
    assert (p.rollout_steps, p.minibatches, p.epochs) == (60, 4, 2)
    assert (p.clip, p.value_coef, p.max_grad_norm) == (0.2, 1.0, 1.0)
    assert (p.desired_kl, p.learning_rate_factor) == (0.01, 1.5)
    assert p.learning_rate_bounds == (1e-5, 1e-2)
    n = PAPER.network
    assert (n.actor, n.critic, n.init_std) == ((512, 256, 128), (768, 256, 128), 1.0)
    assert not n.symmetric and not n.estimator and p.average == 0.0
    assert not n.even_inputs
    e = PAPER.env
    assert PAPER.control_dt == pytest.approx(0.01) and PAPER.episode_steps == 2400
    assert e.least_torque == 0.0
    assert (e.action_scale, e.action_clip, e.observation_clip) == (0.25, 18.0, 18.0)
    assert (e.action_delay, e.action_noise, e.noise_level) == (0.5, 0.02, 0.6)
    assert e.reset_joint_noise == 0.1
    c = PAPER.command
    assert (c.vy, c.heading, c.resample_seconds) == ((-0.3, 0.3), (-3.14, 3.14), 8.0)
    assert (c.dead_zone, c.heading_gain, c.max_yaw_rate) == (0.2, 0.5, 1.0)
    assert (c.stand_fraction, c.forward_fraction, c.narrow_speed) == (0.0, 0.0, 0.0)
    assert (c.top_fraction, c.shortest_seconds) == (0.0, 0.0)
    assert not c.stand_still
    g = PAPER.gait
    assert (g.cycle_time, g.double_support, g.reference_scale) == (0.64, 0.1, 0.17)
    assert (g.reference_speed_gain, g.arm_swing, g.elbow_bend) == (0.0, 0.0, 0.0)
    assert not g.cycle_follows_speed and not g.cycle_from_speed and not g.random_phase
    r = PAPER.randomize
    assert (r.friction, r.ground_friction, r.base_mass) == ((0.1, 2.0), 0.6, (-5.0, 5.0))
    assert (r.push_seconds, r.push_velocity, r.push_angular) == (4.0, 0.2, 0.4)
    assert r.kp == r.kd == r.motor_strength == (1.0, 1.0)
    assert r.base_com == r.joint_friction == r.link_com == r.hand_mass == (0.0, 0.0)
    assert r.link_mass == (1.0, 1.0)
    assert r.sole == r.punch == (0.0, 0.0) and r.held_arms == 0.0
    w = PAPER.rewards
    assert (w.tracking_sigma, w.base_height_target, w.clearance_target) == (5.0, 0.89, 0.06)
    assert w.max_contact_force == 700.0
    assert (w.feet_distance, w.knee_distance) == ((0.2, 0.5), (0.2, 0.25))
    assert (w.lateral_distance, w.lean_per_speed) == (False, 0.0)


def test_our_additions_are_off_in_the_paper():
    assert PAPER.rewards.weights.tracking_mean_vel == PAPER.rewards.restless == 0.0
    assert not PAPER.rewards.clearance_mid_swing and not PAPER.ppo.entropy_fades
    assert (PAPER.gait.stride_sweep, PAPER.gait.double_support_at_speed) == (0.0, 0.1)
    assert PAPER.command.slow_fraction == PAPER.curriculum.settle_seconds == 0.0
    assert PAPER.curriculum.gait_threshold == -1.0  # below the least feet_contact_number, -0.3
    assert PAPER.network.init_mean == 1.0 and PAPER.randomize.noise == (1.0, 1.0)


def test_physics_departs_from_humanoid_gym_at_the_same_control_rate():
    p = PAPER.physics
    assert (p.timestep, p.decimation) == (0.005, 2)
    assert (p.cone, p.iterations, p.ls_iterations) == ("elliptic", 5, 20)
    assert {preset(name).physics for name in PRESETS} == {p}


def test_evaluation_physics():
    """Physics at 1 kHz with a converged solver; the policy still runs at 100 Hz. C MuJoCo only."""
    high = HighFidelity()
    assert (high.timestep, high.decimation, high.fidelity) == (0.001, 10, "high")
    assert (high.cone, high.iterations, high.ls_iterations) == ("elliptic", 100, 50)
    assert high.control_dt == pytest.approx(PAPER.control_dt)
    with pytest.raises(ConfigError, match=r"physics\.engine"):
        HighFidelity(engine="mjx")


def test_base_length_of_the_papers_training():
    """3001 iterations of 4096 x 60 samples, within 0.1 %."""
    assert PAPER.batch_size == 245_760
    assert PAPER.run.steps == pytest.approx(3001 * 245_760, rel=1e-3)
    assert PAPER.num_updates == pytest.approx(3001, abs=3)


# ------------------------------------------------------------------------------ presets, ablations


def test_presets():
    assert set(PRESETS) == {"paper", "laptop", "debug", "baseline", "baseline-laptop"}
    for name in PRESETS:
        assert preset(name) == PRESETS[name]


def test_baseline_is_humanoid_gym():
    assert {k: v[1] for k, v in changes(PAPER, BASELINE).items()} == {
        "env.arms": "held",
        "rewards.velocity_rewards": False,
        "rewards.weights.angular_momentum": 0.0,
        "curriculum.velocity": False,
        "curriculum.cycle": False,
        "curriculum.v_start": 3.5,
    }


LEARNER = {
    "env.num_envs": 2048,
    "env.frames": 5,
    "network.actor": (384, 192, 96),
    "network.critic": (256, 128, 64),
    "network.init_std": 0.6,
    "network.init_mean": 0.01,
    "network.symmetric": True,
    "network.even_inputs": True,
    "ppo.rollout_steps": 24,
    "ppo.epochs": 5,
    "ppo.entropy_coef": 0.003,
    "ppo.learning_rate": 1e-3,
    "ppo.learning_rate_bounds": (1e-5, 1e-3),
    "run.steps": 60_000_000,
}


def test_laptop_departs_from_the_paper_in_these_numbers_only():
    """docs/laptop_recipe.md gives the reason for each number."""
    assert {k: v[1] for k, v in changes(PAPER, LAPTOP).items()} == LEARNER | {
        "env.critic_memory": True,
        "env.least_torque": 0.15,
        "network.estimator": (128, 64),
        "ppo.entropy_fades": True,
        "ppo.average": 0.98,
        "ppo.value_per_command": True,
        "command.shortest_seconds": 1.0,
        "command.stand_fraction": 0.15,
        "command.top_fraction": 0.15,
        "command.brake_fraction": 0.3,
        "command.acceleration": 2.0,
        "command.forward_fraction": 0.2,
        "command.slow_fraction": 0.15,
        "command.narrow_speed": 4.0,
        "command.stand_still": True,
        "gait.double_support_at_speed": -0.4,
        "gait.stride_sweep": 0.35,
        "gait.reference_speed_gain": 1.0,
        "gait.arm_swing": 0.38,
        "gait.arm_swing_slow": 0.25,
        "gait.elbow_bend": 1.0,
        "gait.cycle_from_speed": 0.5,
        "gait.random_phase": True,
        "curriculum.settle_seconds": 2.0,
        "curriculum.v_limit": 4.0,
        "curriculum.gait_threshold": 0.75,
        "curriculum.top_error": 0.05,
        "curriculum.top_error_from": 1.75,
        "curriculum.top_error_floor": 3.0,
        "curriculum.top_falls": 1.0,
        "curriculum.falls_after": 4.0,
        "curriculum.cycle_factor": 0.94,
        "curriculum.cycle_min": 0.38,
        "randomize.base_com": (-0.02, 0.02),
        "randomize.kp": (0.9, 1.1),
        "randomize.kd": (0.9, 1.1),
        "randomize.motor_strength": (0.9, 1.0),
        "randomize.joint_friction": (0.0, 1.0),
        "randomize.link_mass": (0.9, 1.1),
        "randomize.link_com": (-0.01, 0.01),
        "randomize.hand_mass": (0.0, 0.5),
        "randomize.sole": (0.0, 0.02),
        "randomize.punch": (0.0, 200.0),
        "randomize.noise": (0.0, 1.0),
        "rewards.momentum_scale": 3.0,
        "rewards.base_height_kernel": 30.0,
        "rewards.base_height_drop": 0.0,
        "rewards.exact_full": 2.0,
        "rewards.shuffle": 2.0,
        "rewards.clearance_width": 0.03,
        "rewards.clearance_mid_swing": True,
        "rewards.clearance_speed_gain": 0.5,
        "rewards.max_contact_force": 1400.0,
        "rewards.lateral_distance": True,
        "rewards.feet_distance": (0.17, 0.5),
        "rewards.knee_distance": (0.17, 0.25),
        "rewards.lean_per_speed": 0.03,
        "rewards.default_pose_margin": 0.15,
        "rewards.fall": 5.0,
        "rewards.weights.feet_contact_number": 3.0,
        "rewards.weights.feet_clearance": 0.7,
        "rewards.weights.base_height": 0.5,
        "rewards.weights.tracking_lin_vel": 2.0,
        "rewards.weights.track_vel_hard": 0.8,
        "rewards.weights.tracking_mean_vel": 4.0,
        "rewards.weights.dof_acc": -3e-7,
        "rewards.weights.dof_vel_limits": -10.0,
        "rewards.weights.stand_still": -1.0,
        "rewards.weights.tracking_ang_vel": 1.5,
    }
    assert LAPTOP.minibatch_size == 12_288


def test_baseline_laptop_is_the_baseline_with_the_laptops_learner():
    found = changes(BASELINE, preset("baseline-laptop"))
    assert {k: v[1] for k, v in found.items()} == LEARNER


def test_debug_is_a_small_laptop():
    found = changes(LAPTOP, preset("debug"))
    assert {k: v[1] for k, v in found.items()} == {
        "env.num_envs": 16,
        "env.frames": 3,
        "network.actor": (32, 16),
        "network.critic": (32, 16),
        "network.estimator": (16,),
        "ppo.rollout_steps": 8,
        "ppo.minibatches": 2,
        "ppo.epochs": 2,
        "run.steps": 1024,
        "run.checkpoint_minutes": 0.05,
    }


ARMS = ("gait.arm_swing", "gait.arm_swing_slow", "gait.elbow_bend")


@pytest.mark.parametrize("base", ["paper", "laptop"])
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("arms", dict.fromkeys(ARMS, 0.0) | {"env.arms": "held"}),
        ("angular-momentum", {"rewards.weights.angular_momentum": 0.0}),
        ("velocity-rewards", {"rewards.velocity_rewards": False}),
        ("velocity-curriculum", {"curriculum.velocity": False, "curriculum.v_start": 3.5}),
        ("cycle-curriculum", {"curriculum.cycle": False}),
    ],
)
def test_an_ablation_is_one_switch(base, name, expected):
    """The reference pose of `paper` moves no arms, so that only `env.arms` changes there."""
    found = changes(preset(base), preset(base, (name,)))
    here = expected if base == "laptop" else {k: v for k, v in expected.items() if "gait" not in k}
    assert {k: v[1] for k, v in found.items()} == here


def test_held_arms_are_not_asked_to_swing():
    """Eq. 8 takes the norm over the arms too. Held arms would keep it large, and the legs could
    earn nothing with their reference."""
    held = dataclasses.replace(LAPTOP.env, arms="held")
    with pytest.raises(ConfigError, match="held arms cannot follow"):
        dataclasses.replace(LAPTOP, env=held)
    assert dataclasses.replace(PAPER, env=dataclasses.replace(PAPER.env, arms="held"))


def test_all_ablations_at_once():
    assert len(ABLATIONS) == 5
    stripped = preset("paper", tuple(ABLATIONS))
    assert stripped == BASELINE


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_are_static_arguments(name):
    """Configs are hashable and compare by value. The fields of `run` do not count."""
    config = preset(name)
    same = dataclasses.replace(config, run=dataclasses.replace(config.run, steps=7))
    assert hash(config) == hash(same) and config == same
    assert config != dataclasses.replace(config, seed=config.seed + 1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.seed = 1


def test_config_needs_no_jax():
    code = "import sys, kslc_jax.config; sys.exit('jax' in sys.modules or 'mujoco' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_derived_numbers():
    config = preset("debug")
    assert config.batch_size == 128 and config.minibatch_size == 64
    assert config.num_updates == 8  # 1024 / 128
    longer = dataclasses.replace(config, run=dataclasses.replace(config.run, steps=1025))
    assert longer.num_updates == 9


# ----------------------------------------------------------------------------------------- storage


@pytest.mark.parametrize("name", list(PRESETS))
def test_round_trip_through_json(name):
    config = dataclasses.replace(preset(name, ("arms",)), seed=3)
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, keep=9))
    back = from_dict(json.loads(json.dumps(to_dict(config))))
    assert back == config and hash(back) == hash(config)
    assert back.run == config.run  # not part of ==
    assert to_dict(config)["schema"] == 1


def edited(path: str, value: Any = None, *, remove: bool = False) -> dict[str, Any]:
    data = json.loads(json.dumps(to_dict(PAPER)))
    *parents, last = path.split(".")
    at = data
    for name in parents:
        at = at[name]
    if remove:
        del at[last]
    else:
        at[last] = value
    return data


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("ppo.gama", 0.9, "config.ppo: unknown field gama"),
        ("extra", 1, "config: unknown field extra"),
        ("env.num_envs", "many", 'config.env.num_envs: "many" is not a valid value'),
        ("env.num_envs", 4096.5, "config.env.num_envs: 4096.5 is not a valid value"),
        ("env.num_envs", True, "config.env.num_envs: true is not a valid value"),
        ("env.arms", "folded", 'config.env.arms: "folded" is not a valid value'),
        ("ppo.gamma", None, "config.ppo.gamma: null is not a valid value"),
        ("ppo.gamma", False, "config.ppo.gamma: false is not a valid value"),
        ("rewards.only_positive", 1, "config.rewards.only_positive: 1 is not a valid value"),
        ("command.vy", 0.3, "config.command.vy: 0.3 is not a valid value"),
        (
            "command.vy",
            [0.1, 0.2, 0.3],
            r"config.command.vy: \[0.1, 0.2, 0.3\] is not a valid value",
        ),
        ("command.vy", [0.1, "b"], 'config.command.vy: "b" is not a valid value'),
        ("network.actor", [64, 0.5], "config.network.actor: 0.5 is not a valid value"),
        ("rewards.weights", 3, "config.rewards.weights: expected an object, got int"),
        ("schema", 2, "schema version 2, this kslc_jax reads version 1"),
        ("schema", None, "schema version None"),
        ("command.vy", [0.3, -0.3], "command.vy: lower bound 0.3 is above upper bound -0.3"),
    ],
)
def test_wrong_stored_field_is_named(path, value, message):
    with pytest.raises(ConfigError, match=message):
        from_dict(edited(path, value))


def test_retired_field_of_an_older_file_is_passed_over():
    assert from_dict(edited("physics.clamp_joint_speed", True)) == PAPER


def test_a_file_without_its_schema_is_refused():
    with pytest.raises(ConfigError, match="schema version None"):
        from_dict(edited("schema", remove=True))


def test_stored_config_must_be_an_object():
    with pytest.raises(ConfigError, match="not a JSON object"):
        from_dict([1, 2])  # ty: ignore[invalid-argument-type]


def test_whole_numbers_are_read_as_floats():
    config = from_dict(edited("ppo.gamma", 1))
    assert config.ppo.gamma == 1.0 and type(config.ppo.gamma) is float
    assert type(from_dict(edited("command.vy", [-1, 1])).command.vy[0]) is float


def test_reading_does_not_change_its_argument():
    data = to_dict(PAPER)
    from_dict(data)
    assert data == to_dict(PAPER)


# ------------------------------------------------------------------------------------------ errors


@pytest.mark.parametrize(
    ("name", "without", "message"),
    [
        ("papr", (), "unknown preset 'papr', did you mean 'paper'"),
        ("labtop", (), "did you mean 'laptop'"),
        ("xyzzy", (), r"unknown preset 'xyzzy' \(known: paper, laptop, debug, baseline"),
        ("paper", ("arm",), "unknown ablation 'arm', did you mean 'arms'"),
        ("paper", ("momentum",), "unknown ablation 'momentum', did you mean 'angular-momentum'"),
    ],
)
def test_unknown_names(name, without, message):
    with pytest.raises(ConfigError, match=message):
        preset(name, without)


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("physics", "timestep", 0.0),
        ("physics", "decimation", 0),
        ("physics", "iterations", 0),
        ("physics", "ls_iterations", 0),
        ("physics", "threads", -1),
        ("env", "num_envs", 0),
        ("env", "episode_seconds", 0.0),
        ("env", "frames", 0),
        ("env", "privileged_frames", 0),
        ("env", "action_delay", 1.1),
        ("env", "action_clip", 0.0),
        ("env", "observation_clip", -1.0),
        ("command", "vy", (0.3, -0.3)),
        ("command", "heading", (1.0, 0.0)),
        ("command", "resample_seconds", 0.0),
        ("command", "stand_fraction", 1.1),
        ("command", "forward_fraction", -0.1),
        ("command", "slow_fraction", 1.1),
        ("command", "slow_speed", 0.0),
        ("gait", "cycle_time", 0.0),
        ("gait", "double_support", 1.0),
        ("gait", "full_speed", 0.0),
        ("randomize", "friction", (2.0, 0.1)),
        ("randomize", "friction", (-0.1, 0.1)),
        ("randomize", "ground_friction", -0.1),
        ("randomize", "base_mass", (5.0, -5.0)),
        ("randomize", "kp", (-0.1, 1.0)),
        ("rewards", "momentum_scale", 0.0),
        ("rewards", "momentum_floor", 0.0),
        ("rewards", "clearance_width", 0.0),
        ("curriculum", "cycle_factor", 1.1),
        ("curriculum", "v_step", 0.0),
        ("curriculum", "v_start", 4.0),
        ("curriculum", "v_start", 0.0),
        ("curriculum", "v_min", 1.0),
        ("curriculum", "smoothing", 1.0),
        ("network", "actor", (64, 0)),
        ("network", "init_std", 0.0),
        ("ppo", "rollout_steps", 0),
        ("ppo", "minibatches", 0),
        ("ppo", "epochs", 0),
        ("ppo", "gamma", 1.1),
        ("ppo", "lam", -0.1),
        ("ppo", "clip", 0.0),
        ("ppo", "max_grad_norm", -1.0),
        ("ppo", "desired_kl", 0.0),
        ("ppo", "learning_rate_factor", 0.0),
        ("ppo", "learning_rate_bounds", (1e-2, 1e-5)),
        ("ppo", "learning_rate_bounds", (-1e-2, 1.0)),
        ("command", "heading_gain", 0.0),
        ("command", "max_yaw_rate", 0.0),
        ("run", "steps", 0),
        ("run", "log_every", 0),
        ("run", "checkpoint_minutes", 0.0),
        ("run", "keep", 0),
        ("run", "snapshots", -1),
    ],
)
def test_bad_values_are_refused(part, field, value):
    """The message names the part and the field. For networks the part is enough."""
    with pytest.raises(ConfigError, match=f"{part}") as error:
        dataclasses.replace(getattr(PAPER, part), **{field: value})
    assert field in str(error.value) or part == "network"


def test_batch_must_split_into_minibatches():
    with pytest.raises(ConfigError, match="7 does not divide the batch of 4096 envs x 60 steps"):
        dataclasses.replace(PAPER, ppo=dataclasses.replace(PAPER.ppo, minibatches=7))


@pytest.mark.parametrize(
    ("field", "value", "less"),
    [
        ("settle_seconds", 8.0, 7.9),  # a command lasts 8 s
        ("min_episode_steps", 2400.0, 2399.0),  # a moving average never reaches the maximum, 2400
    ],
)
def test_a_gate_that_could_never_open_is_refused(field, value, less):
    def gated(x):
        return dataclasses.replace(
            PAPER, curriculum=dataclasses.replace(PAPER.curriculum, **{field: x})
        )

    assert getattr(gated(less).curriculum, field) == less
    with pytest.raises(ConfigError, match=f"curriculum.{field}"):
        gated(value)


def test_seed_must_not_be_negative():
    with pytest.raises(ConfigError, match="seed"):
        Config(seed=-1)


LATER_FIELDS = {
    "physics.cone": "pyramidal",
    "command.slow_fraction": 0.0,
    "command.slow_speed": 1.0,
    "command.brake_fraction": 0.0,
    "command.acceleration": 0.0,
    "curriculum.falls_after": 0.0,
    "network.init_mean": 1.0,
    "ppo.entropy_fades": False,
    "ppo.value_per_command": False,
    "gait.double_support_at_speed": 0.1,
    "gait.stride_sweep": 0.0,
    "rewards.weights.tracking_mean_vel": 0.0,
    "rewards.clearance_mid_swing": False,
    "rewards.restless": 0.0,
    "rewards.contact_force_range": 400.0,
    "rewards.longest_air_time": 0.5,
    "rewards.exact_from": 0.5,
    "rewards.exact_full": 2.5,
    "curriculum.gait_threshold": -1.0,
    "curriculum.gait_from": 0.0,
    "curriculum.top_error_from": 0.0,
    "randomize.noise": (1.0, 1.0),
    "run.snapshots": 24,
}
"""Fields that the oldest files lack, with the values that reproduce the old behaviour."""


@pytest.mark.parametrize(("path", "then"), LATER_FIELDS.items())
def test_fields_that_older_files_lack_have_their_default(path, then):
    assert operator.attrgetter(path)(Config()) == then
    back = from_dict(edited(path, remove=True))
    expected = from_dict(edited(path, then))
    assert back == expected and back.run == expected.run


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("without", [(), ("arms",), tuple(ABLATIONS)])
def test_options_give_the_config_back(name, without):
    wanted = preset(name, without)
    wanted = dataclasses.replace(
        wanted,
        seed=7,
        gait=dataclasses.replace(wanted.gait, random_phase=not wanted.gait.random_phase),
        network=dataclasses.replace(wanted.network, actor=(8, 4), estimator=()),
        ppo=dataclasses.replace(wanted.ppo, learning_rate_bounds=(1e-6, 1e-2)),
        run=dataclasses.replace(wanted.run, steps=12345),
    )
    options = config_lib.options(wanted)
    parsed = train.parse(options).config
    assert parsed == wanted and parsed.run == wanted.run
    assert options[:2] == ["--preset", name] or without


def test_options_name_only_what_differs():
    debug = preset("debug")
    assert config_lib.options(debug) == ["--preset", "debug"]
    faster = dataclasses.replace(debug, ppo=dataclasses.replace(debug.ppo, learning_rate=1e-4))
    assert config_lib.options(faster) == ["--preset", "debug", "--ppo.learning-rate", "0.0001"]


def test_a_contact_without_any_friction_is_refused():
    """MJX divides by it in elliptic cones."""
    with pytest.raises(ConfigError, match=r"randomize\.ground_friction"):
        RandomizeConfig(friction=(0.0, 1.0), ground_friction=0.0)
    assert RandomizeConfig(friction=(0.0, 1.0), ground_friction=0.1).friction[0] == 0.0
