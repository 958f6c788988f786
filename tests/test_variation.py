"""Robots that differ and what disturbs them: the model and the forces that come of it."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from states import XBOT, still_policy

from kslc_jax import physics, randomize, robot
from kslc_jax.config import XBOT_L, ConfigError, HighFidelity, preset
from kslc_jax.evaluation import trials, variation
from kslc_jax.evaluation.perturbations import Variation
from kslc_jax.robots import description

DT = 0.01


def changed(wanted: Variation, seed: int = 0) -> tuple[mujoco.MjModel, variation.Body]:
    """The high-fidelity model of one robot that differs."""
    xbot = robot.load("high")
    body = variation.sample(wanted, xbot, jax.random.key(seed))
    fields = randomize.model_fields(xbot, randomize.nominal(XBOT), 1.0)
    fields = variation.alter(wanted, xbot, body, jax.random.key(seed + 100), fields)
    model = copy.copy(xbot.mj_model)
    for name, value in fields.items():
        getattr(model, name)[:] = np.asarray(value)
    return model, body


def inverse_inertia(model: mujoco.MjModel) -> np.ndarray:
    """[nv, nv] inverse mass matrix with bent elbows."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[-4:] = 0.5
    mujoco.mj_forward(model, data)
    inverse = np.zeros((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return inverse


def test_heavier_hands_are_point_masses_at_the_hands():
    """The mass matrix equals MuJoCo's for a model with two more bodies, one at each hand."""
    spec = mujoco.MjSpec.from_file(str(description.read(XBOT_L).mjcf))
    hands = robot.load("high").mj_model
    for side in ("left", "right"):
        at = hands.geom(f"{side}_hand").pos
        more = spec.body(f"{side}_elbow_pitch_link").add_body(name=f"{side}_load", pos=at)
        more.mass, more.inertia, more.explicitinertial = 0.5, np.full(3, 1e-9), True
        more.ipos = np.zeros(3)
    expected = inverse_inertia(spec.compile())
    model, _ = changed(Variation(hands=0.5))
    np.testing.assert_allclose(inverse_inertia(model), expected, rtol=1e-4, atol=1e-4)
    assert np.abs(expected - inverse_inertia(hands)).max() > 0.1
    assert model.body_subtreemass[1] == pytest.approx(hands.body_subtreemass[1] + 1.0)


def test_joints_have_their_own_friction_and_damping():
    model, body = changed(Variation(joints=1.0))
    nominal = robot.load("high").mj_model
    np.testing.assert_allclose(
        model.dof_damping[6:] - nominal.dof_damping[6:], body.damping, atol=1e-6
    )
    np.testing.assert_allclose(
        model.dof_frictionloss[6:] - nominal.dof_frictionloss[6:], body.friction, atol=1e-6
    )
    assert len(set(np.r_[body.damping, body.friction])) == 32 and not model.dof_damping[:6].any()


def test_soles_wander_inside_the_foot_on_two_to_four_corners():
    """The foot lies flat on the floor, 0.1 mm deep."""
    counts = []
    for seed in range(20):
        model, _ = changed(Variation(sole=0.02), seed)
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        foot = model.geom("left_foot").id
        lowest = data.xpos[model.geom_bodyid[foot], 2] - 0.056  # sole below the ankle
        data.qpos[2] -= lowest + 1e-4
        mujoco.mj_forward(model, data)
        touching = [c for c in data.contact if foot in c.geom]
        counts.append(len(touching))
        corners = np.array([c.pos - data.xpos[model.geom_bodyid[foot]] for c in touching])
        if len(corners):
            assert (corners[:, 0] <= 0.134 + 1e-3).all() and (corners[:, 0] >= -0.074 - 1e-3).all()
            assert (np.abs(corners[:, 1]) <= 0.044 + 1e-3).all()
    assert min(counts) >= 1 and max(counts) <= 4 and len(set(counts)) > 1


@pytest.mark.parametrize("wrong", [{"hands": -1.0}, {"sole": 0.1}, {"joints": -1}])
def test_what_no_robot_can_be_is_refused(wrong):
    with pytest.raises(ConfigError):
        Variation(**wrong)


# ------------------------------------------------------------------------------ in a trial


def test_a_force_moves_the_whole_robot_as_newton_says():
    """In the air, over one control step: F t / m; and the step after is free of it."""
    config = HighFidelity()
    xbot = physics.robot_for(config)
    qpos = jnp.asarray(xbot.default_qpos, jnp.float32).at[2].set(3.0)
    state = physics.initial_state(config, qpos, jnp.zeros(xbot.mj_model.nv))
    target = qpos[7:]
    force = jnp.zeros((xbot.mj_model.nbody, 6)).at[xbot.anatomy.base, 1].set(300.0)
    step = jax.jit(
        lambda s, f: physics.step(config, s, target, randomize.nominal(XBOT), 1.0, force=f)
    )

    def momentum(s):
        data = mujoco.MjData(xbot.mj_model)
        data.qpos[:], data.qvel[:] = s.qpos, s.qvel
        mujoco.mj_forward(xbot.mj_model, data)
        mujoco.mj_subtreeVel(xbot.mj_model, data)
        return xbot.total_mass * data.subtree_linvel[0]

    pushed = step(state, force)
    np.testing.assert_allclose(momentum(pushed)[1], 300.0 * config.control_dt, rtol=1e-3)
    after = step(pushed, jnp.zeros_like(force))
    np.testing.assert_allclose(momentum(after)[1], 300.0 * config.control_dt, rtol=1e-3)


@pytest.mark.slow(reason="compiles two trials")
def test_a_disturbed_trial_is_of_its_own_robots():
    """Two robots of other masses; arms that move though the policy asks for nothing; and a nominal
    trial after it is of the described robot again."""
    still = still_policy(preset("debug"))
    plain = trials.Setting(HighFidelity(), seconds=1.0)

    def run(setting):
        return next(iter(trials.run(still, setting, np.zeros((2, 3)), chunk=0.3)))

    before = run(plain)
    wanted = Variation(hands=0.5, sole=0.01, joints=1.0)
    links = dataclasses.replace(
        trials.NOMINAL, link_mass=(0.9, 1.1), punch=(100.0, 100.0), held_arms=1.0
    )
    odd = run(dataclasses.replace(plain, randomize=links, variation=wanted))
    np.testing.assert_array_equal(run(plain).qpos, before.qpos)
    assert np.ptp(odd.mass[0]) > 0.01 and np.ptp(odd.mass[:, 0]) == 0.0
    assert np.abs(odd.qpos - before.qpos)[-1].max() > 1e-3
