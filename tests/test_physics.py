"""Both engines: torque limits, parity, batch independence, divergence."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import slow
from states import XBOT

from kslc_jax import maths, motors, physics, randomize, robot
from kslc_jax.config import (
    XBOT_L,
    EnvConfig,
    HighFidelity,
    PhysicsConfig,
    RandomizeConfig,
    preset,
)
from kslc_jax.robots import description

ENGINES = ("mjx", "mujoco")
QUICK_FIRST = ("mujoco", *slow.cases("compiles MJX again", "mjx"))
"""Engines of tests that compile a program of their own; `runs` compares the engines."""
GROUND = 0.6


def make_step(engine: str, **changes):
    config = PhysicsConfig(engine=engine, **changes)
    return jax.jit(lambda s, t, d: physics.step(config, s, t, d, GROUND))


def standing(config: PhysicsConfig) -> physics.PhysicsState:
    """State of a robot at rest with its feet on the floor."""
    qpos = jnp.asarray(physics.robot_for(config).default_qpos, jnp.float32).at[2].set(0.885)
    return physics.initial_state(config, qpos, jnp.zeros(22))


@pytest.mark.parametrize(("least", "ankle"), [(0.0, 0.25), (0.04, 0.25), (0.15, 0.85)])
def test_soft_servos_have_larger_actions(least, ankle):
    """By hand: 0.15 x 85 N m / (15 N m/rad) = 0.85 rad. All other servos are stiff enough."""
    scale = motors.action_scale(EnvConfig(least_torque=least), XBOT)
    expected = ([0.25] * 4 + [ankle] * 2) * 2 + [0.25] * 4
    np.testing.assert_allclose(scale, expected, rtol=1e-6)


class TestMotorTorque:
    """By hand. The left knee has kp 350, kd 10, effort limit 212.5 N m, speed limit 12 rad/s."""

    KNEE = 3

    def torque(self, q=0.0, dq=0.0, target=0.0, **factors):
        dyn = randomize.nominal(XBOT).replace(**factors)
        return motors.motor_torque(
            robot.load(),
            dyn,
            jnp.full(16, q),
            jnp.full(16, dq),
            jnp.full(16, target),
        )[self.KNEE]

    def test_pd(self):
        assert self.torque(q=0.1, dq=1.0, target=0.3) == pytest.approx(350 * 0.2 - 10.0)

    def test_effort_limit_is_085_of_the_urdf(self):
        assert self.torque(target=2.0) == pytest.approx(0.85 * 250)
        assert self.torque(target=-2.0) == pytest.approx(-0.85 * 250)

    @pytest.mark.parametrize(
        ("dq", "available"),
        [
            *((9.0, 212.5), (10.5, 106.25), (12.0, 0.0)),
            *((13.5, -106.25), (15.0, -212.5), (18.0, -212.5), (-15.0, 212.5)),
        ],
    )
    def test_driving_torque_falls_to_zero_at_the_speed_limit_and_brakes_beyond(self, dq, available):
        """The torque falls from 9 rad/s on, 75 % of 12; half is left at 10.5. Braking (dq < 0)
        keeps the full torque."""
        assert self.torque(dq=dq, target=5.0) == pytest.approx(available, abs=1e-4)
        assert self.torque(dq=-dq, target=-5.0) == pytest.approx(-available, abs=1e-4)

    def test_factors(self):
        half = jnp.full(16, 0.5)
        assert self.torque(target=0.2, kp=half) == pytest.approx(35.0)
        assert self.torque(dq=2.0, kd=half) == pytest.approx(-10.0)
        assert self.torque(target=5.0, motor_strength=half) == pytest.approx(106.25)
        friction = self.torque(dq=2.0, joint_friction=half)
        assert friction == pytest.approx(-20.0 - 0.5 * np.tanh(10.0))

    def test_numpy_and_jax_agree(self):
        rng = np.random.default_rng(0)
        q, dq, target = rng.normal(size=(3, 16)) * 4
        dyn = randomize.nominal(XBOT)
        a = motors.motor_torque(robot.load(), dyn, q, dq, target)
        b = motors.motor_torque(robot.load(), jax.tree.map(np.asarray, dyn), q, dq, target, np)
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4)
        a = motors.motor_damping(robot.load(), dyn, q, dq, target, a)
        b = motors.motor_damping(robot.load(), dyn, q, dq, target, b, np)
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)


class TestMotorDamping:
    def test_of_a_servo_within_its_limits(self, xbot):
        """The damping is 0.6 kd where no limit changes the PD torque at both ends of the step."""
        rng = np.random.default_rng(3)
        q, dq, target = rng.normal(size=(3, 16)) * [[0.05], [0.5], [0.05]]
        torque = motors.motor_torque(xbot, randomize.nominal(XBOT), q, dq, target, np)
        damping = motors.motor_damping(xbot, randomize.nominal(XBOT), q, dq, target, torque, np)
        np.testing.assert_allclose(damping, 0.6 * xbot.kd, rtol=1e-5)

    @pytest.mark.parametrize("dq", [-18.0, -4.0, 0.0, 8.0, 11.0, 18.0])
    @pytest.mark.parametrize("target", [-4.0, 0.3, 4.0])
    def test_a_joint_alone_moves_by_the_theta_method(self, xbot, dq, target):
        """The speed after a step with this damping solves the theta-method's equation
        M dv = h (0.4 torque(dq) + 0.6 torque(dq + dv)). Bisection finds its solution."""
        dyn, h = randomize.nominal(XBOT), xbot.mj_model.opt.timestep
        q, dq, target = np.zeros(16), np.full(16, dq), np.full(16, target)

        def torque(speed):
            return motors.motor_torque(xbot, dyn, q, speed, target, np)

        low, high = dq - 300.0, dq + 300.0
        for _ in range(60):
            speed = 0.5 * (low + high)
            mean = 0.4 * torque(dq) + 0.6 * torque(speed)
            below = speed - dq < h / xbot.joint_inertia * mean
            low, high = np.where(below, speed, low), np.where(below, high, speed)
        damping = motors.motor_damping(xbot, dyn, q, dq, target, torque(dq), np)
        change = h * torque(dq) / (xbot.joint_inertia + h * damping)
        np.testing.assert_allclose(dq + change, speed, atol=0.02)
        assert np.all(damping > -1e-6)

    def test_inertia_of_a_joint_alone(self, xbot):
        """In the air, 1 N m at each joint in turn: the change of its acceleration gives the
        inertia."""
        data = mujoco.MjData(xbot.mj_model)
        for i in range(16):
            mujoco.mj_resetDataKeyframe(xbot.mj_model, data, xbot.mj_model.keyframe("home").id)
            data.qpos[2] = 3.0
            mujoco.mj_forward(xbot.mj_model, data)
            rest = data.qacc_smooth[6 + i]
            data.qfrc_applied[6 + i] = 1.0
            mujoco.mj_forward(xbot.mj_model, data)
            data.qfrc_applied[6 + i] = 0.0
            apart = data.qacc_smooth[6 + i] - rest
            assert 1.0 / apart == pytest.approx(xbot.joint_inertia[i], rel=1e-6)


def test_servo_control_inverts_the_models_servo(xbot):
    """The model's servo torque, kp (ctrl - q) - damping dq, equals the wanted torque."""
    rng = np.random.default_rng(1)
    q, dq, torque, damping = rng.normal(size=(4, 16)) * [[0.5], [5.0], [100.0], [30.0]]
    ctrl = motors.servo_control(xbot, torque, damping, q, dq)
    np.testing.assert_allclose(xbot.kp * (ctrl - q) - damping * dq, torque, rtol=1e-9)


@pytest.mark.parametrize(
    "config",
    [
        *slow.cases("compiles MJX", PhysicsConfig(engine="mjx")),
        PhysicsConfig(engine="mujoco"),
        HighFidelity(),
    ],
    ids=["mjx", "mujoco", "high fidelity"],
)
def test_no_motor_drives_a_joint_past_its_speed_limit(config):
    """Shoulders, then knees, at full command in the air. Their speeds approach the limits, 7 and 12
    rad/s, and pass them by 1 % at most. An explicit step of 5 ms would change the speed of an
    unloaded knee by 20 rad/s."""
    step = jax.jit(lambda s, t, d: physics.step(config, s, t, d, GROUND))
    for joints, there, limit in (((12, 14), 3.1, 7.0), ((3, 9), 1.2, 12.0)):
        state = standing(config)
        state = state.replace(qpos=state.qpos.at[2].set(3.0))
        target = jnp.zeros(16).at[jnp.array(joints)].set(jnp.array([-there, there]))
        fastest = 0.0
        for _ in range(30):
            state = step(state, target, randomize.nominal(XBOT))
            fastest = max(fastest, float(jnp.abs(state.qvel[6 + jnp.array(joints)]).max()))
        assert 0.75 * limit < fastest <= 1.01 * limit


@pytest.mark.parametrize(
    "config", [PhysicsConfig(engine="mujoco"), HighFidelity()], ids=["train", "high fidelity"]
)
def test_braking_brings_a_joint_back_to_its_limit(config):
    """Knees start at 18 rad/s, and their targets are far ahead. After 20 ms they are below 12.4
    rad/s. The brake torques are internal: only gravity changes the momentum of the whole robot."""
    step = jax.jit(lambda s, t, d: physics.step(config, s, t, d, GROUND))
    robot = physics.robot_for(config)
    state = standing(config)
    qvel = state.qvel.at[jnp.array([9, 15])].set(jnp.array([-18.0, 18.0]))
    state = state.replace(qpos=state.qpos.at[2].set(3.0), qvel=qvel)
    before = momentum(robot, state)
    target = jnp.zeros(16).at[jnp.array([3, 9])].set(jnp.array([-4.0, 4.0]))
    for _ in range(2):
        state = step(state, target, randomize.nominal(XBOT))
    assert np.abs(state.qvel[jnp.array([9, 15])]).max() < 12.4
    pulled = before - [0.0, 0.0, 0.02 * 9.81 * robot.total_mass]
    np.testing.assert_allclose(momentum(robot, state), pulled, atol=1.0)


def momentum(robot, state):
    """Linear momentum of the whole robot in the world frame [3, kg m/s]."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    mujoco.mj_forward(robot.mj_model, data)
    mujoco.mj_subtreeVel(robot.mj_model, data)
    return robot.total_mass * data.subtree_linvel[0]


@pytest.fixture(scope="module", params=["elliptic", *slow.cases("compiles MJX again", "pyramidal")])
def cone(request):
    """Shape of the friction cone."""
    return request.param


@pytest.fixture(scope="module")
def runs(cone):
    """100 control steps of both engines from standing, with small sine targets: 8 environments with
    randomised dynamics."""
    config = RandomizeConfig(kp=(0.9, 1.1), kd=(0.9, 1.1), base_com=(-0.02, 0.02), sole=(0.0, 0.02))
    keys = jax.random.split(jax.random.key(0), 8)
    dyn = jax.vmap(lambda key: randomize.sample(config, XBOT, key))(keys)
    out = {}
    for engine in ENGINES:
        c = PhysicsConfig(engine=engine, cone=cone, iterations=10, ls_iterations=50)
        step = jax.jit(jax.vmap(lambda s, t, d, c=c: physics.step(c, s, t, d, GROUND)))
        state = jax.vmap(lambda _, c=c: standing(c))(jnp.arange(8))
        states = []
        for i in range(100):
            phase = 2 * jnp.pi * 0.01 * i + jnp.arange(16.0)
            state = step(state, jnp.tile(0.05 * jnp.sin(phase), (8, 1)), dyn)
            states.append(jax.tree.map(np.asarray, state))
        out[engine] = states
    return out


APART = {
    "elliptic": ((4, 5e-6, 1e-4), (9, 1e-5, 1e-4), (99, 2e-5, 3e-4)),
    "pyramidal": ((4, 1e-6, 1e-4), (9, 1e-5, 2e-3), (99, 1e-4, 0.1)),
}
"""Control step, median and largest difference of the engines there (qpos, m and rad)."""


def test_engines_agree_over_100_steps(cone, runs):
    """float32 MJX against float64 C, with the feet in contact from the start.

    While no contact opens or closes, the engines agree to some 1e-6. Rounding decides in which step
    a contact opens or closes, and a robot that tips amplifies the difference. With elliptic cones
    the worst of 8 robots differs by 3e-5 after 100 control steps. With pyramids it differs by 1e-3
    after 10 and by 0.05 after 100.
    """
    for i, median, worst in APART[cone]:
        apart = np.abs(runs["mjx"][i].qpos - runs["mujoco"][i].qpos).max(axis=1)
        assert np.median(apart) < median and apart.max() < worst, (i, apart)
    last = runs["mujoco"][-1]
    assert np.all(last.qpos[:, 2] > 0.7), "the robots should still stand"
    assert np.all(last.sensordata[:, -2:].sum(1) > 200), "and weigh on their feet"


def test_torques_and_sensors_agree(runs):
    """The engines agree in torques and sensors too, which the rewards read."""
    for name, tolerance in (("torque", 1e-2), ("sensordata", 1e-1)):
        a, b = (getattr(runs[engine][9], name) for engine in ENGINES)
        assert np.median(np.abs(a - b).max(axis=1)) < tolerance


AROUND = np.linspace(0.0, np.pi / 2, 5)
"""Directions [rad] of a slide. The pyramid's friction is the same in the other three quarters."""


def friction_of_a_slide(config: PhysicsConfig, friction: float) -> np.ndarray:
    """Braking by vertical impulse of the ground [5] on a robot that slides on both feet with 1 m/s,
    for each direction of `AROUND`, during one control step."""
    robot, start = physics.robot_for(config), standing(config)
    dynamics = randomize.nominal(robot, friction)
    across = np.stack([np.cos(AROUND), np.sin(AROUND)], axis=1)
    states = jax.vmap(lambda v: start.replace(qvel=start.qvel.at[:2].set(v)))(across)
    moved = jax.vmap(lambda s: physics.step(config, s, jnp.zeros(16), dynamics, friction))(states)
    before, after = (
        np.stack([momentum(robot, jax.tree.map(lambda x, i=i: x[i], s)) for i in range(5)])
        for s in (states, moved)
    )
    change = after - before
    weight = robot.total_mass * 9.81 * config.control_dt
    return -(change[:, :2] * across).sum(axis=1) / (change[:, 2] + weight)


def test_friction_is_the_same_in_all_directions():
    """Friction in a pyramid acts along its nearest edge, so 0.71 of it brakes at 45 degrees."""
    config = dataclasses.replace(preset("paper").physics, engine="mujoco")
    np.testing.assert_allclose(friction_of_a_slide(config, 0.35), 0.35, rtol=0.04)
    pyramid = dataclasses.replace(config, cone="pyramidal", iterations=30, ls_iterations=30)
    along = 0.35 * np.maximum(np.cos(AROUND), np.sin(AROUND))
    np.testing.assert_allclose(friction_of_a_slide(pyramid, 0.35), along, rtol=0.01)


def solver_error(config: PhysicsConfig) -> float:
    """90th percentile of the error of the fastest joint [rad/s] after a control step, against a
    converged solver: 64 robots on slippery ground that fall with random targets."""
    keys = jax.random.split(jax.random.key(0), 64)
    slippery = RandomizeConfig(friction=(0.1, 0.7))
    dynamics = jax.vmap(lambda key: randomize.sample(slippery, XBOT, key))(keys)
    converged = dataclasses.replace(config, iterations=100, ls_iterations=100)
    step, exact = (
        jax.jit(jax.vmap(lambda s, t, d, c=c: physics.step(c, s, t, d, GROUND)))
        for c in (config, converged)
    )
    state, apart = jax.vmap(lambda _: standing(config))(jnp.arange(64)), []
    for i in range(60):
        target = 0.2 * jax.random.normal(jax.random.key(i), (64, 16))
        state, other = step(state, target, dynamics), exact(state, target, dynamics)
        apart.append(np.abs(state.qvel - other.qvel)[:, 6:].max(axis=1))
    return float(np.quantile(np.array(apart), 0.9))


def test_few_iterations_go_far():
    """The presets' iterations make less than a fifth of the error of the older ones in pyramids."""
    config = dataclasses.replace(preset("paper").physics, engine="mujoco")
    older = dataclasses.replace(config, cone="pyramidal", iterations=4, ls_iterations=5)
    assert solver_error(config) < 0.5 < 5 * 0.5 < solver_error(older)


@pytest.mark.parametrize(("asked", "elliptic"), [(3, 3), (5, 5), (20, 5), (50, 12)])
def test_mjx_searches_less_in_elliptic_cones(asked, elliptic):
    for cone, found in (("elliptic", elliptic), ("pyramidal", asked)):
        config = PhysicsConfig(engine="mjx", cone=cone, ls_iterations=asked)
        assert physics._mjx_model(config).opt.ls_iterations == found


@pytest.mark.parametrize("engine", QUICK_FIRST)
def test_legs_do_not_pass_through_each_other(engine):
    """In the air, both hips close. The feet come to rest side by side."""
    qpos = jnp.asarray(robot.load().default_qpos, jnp.float32).at[2].set(5.0)
    state = physics.initial_state(PhysicsConfig(engine=engine), qpos, jnp.zeros(22))
    step = make_step(engine)
    closed = jnp.zeros(16).at[jnp.array([0, 6])].set(jnp.array([-0.3, 0.3]))
    for _ in range(40):
        state = step(state, closed, randomize.nominal(XBOT))
    feet = [state.sensordata[robot.load().sensor(f"{s}_foot_pos")] for s in ("left", "right")]
    across = maths.quat_rotate_inverse(state.qpos[3:7], feet[0] - feet[1])[1]
    assert 0.08 < across < 0.13


def test_threads_do_not_change_results():
    config = PhysicsConfig(engine="mujoco")
    dyn = jax.tree.map(lambda x: jnp.tile(x, (4,) + (1,) * x.ndim), randomize.nominal(XBOT))
    states = []
    for threads in (1, 2):
        c = dataclasses.replace(config, threads=threads)
        step = jax.jit(jax.vmap(lambda s, t, d, c=c: physics.step(c, s, t, d, GROUND)))
        state = jax.vmap(lambda _: standing(config))(jnp.arange(4))
        for i in range(20):
            state = step(state, jnp.full((4, 16), 0.05 * np.sin(i)), dyn)
        states.append(state)
    for a, b in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_batch_is_its_members():
    """The mujoco engine: environment 1 of a batch equals the same environment alone."""
    config = PhysicsConfig(engine="mujoco")
    single = make_step("mujoco")
    batched = jax.jit(jax.vmap(lambda s, t, d: physics.step(config, s, t, d, GROUND)))
    keys = jax.random.split(jax.random.key(1), 3)
    dyn = jax.vmap(lambda key: randomize.sample(RandomizeConfig(), XBOT, key))(keys)
    state = jax.vmap(lambda _: standing(config))(jnp.arange(3))
    target = 0.1 * jax.random.normal(jax.random.key(2), (3, 16))
    many = batched(state, target, dyn)

    def pick(tree):
        return jax.tree.map(lambda x: x[1], tree)

    one = single(pick(state), target[1], pick(dyn))
    for a, b in zip(jax.tree.leaves(pick(many)), jax.tree.leaves(one), strict=True):
        np.testing.assert_array_equal(a, b)


def test_friction_is_the_mean_of_foot_and_ground(xbot):
    """(0.4 + 0.6) / 2 = 0.5. The model file has 1."""
    fields = randomize.model_fields(xbot, randomize.nominal(XBOT, 0.4), GROUND)
    np.testing.assert_allclose(fields["geom_friction"][xbot.foot_geom_ids, 0], 0.5)


def test_added_mass_weighs(xbot):
    """5 kg more on the base give 49 N more ground force after the robot has settled."""
    step = make_step("mujoco")
    force = []
    for extra in (0.0, 5.0):
        dyn = randomize.nominal(XBOT).replace(base_mass=jnp.asarray(extra))
        state = standing(PhysicsConfig(engine="mujoco"))
        total = []
        for i in range(60):
            state = step(state, jnp.zeros(16), dyn)
            if i >= 30:
                total.append(float(state.sensordata[-2:].sum()))
        force.append(np.mean(total))
    assert force[1] - force[0] == pytest.approx(5 * 9.81, abs=8)


def test_mass_randomisation_matches_a_recompiled_model(xbot):
    """Masses, centres of mass and subtree masses equal those of an edited model. The CoM sensor
    needs the subtree masses."""
    fields = randomize.model_fields(
        xbot,
        randomize.nominal(XBOT).replace(
            base_mass=jnp.asarray(4.0), base_com=jnp.array([0.05, 0, 0])
        ),
        GROUND,
    )
    spec = mujoco.MjSpec.from_file(str(description.read(XBOT_L).mjcf))
    base = spec.body("base_link")
    base.ipos = base.ipos + np.array([0.05, 0, 0])
    base.mass += 4.0
    model = spec.compile()
    np.testing.assert_allclose(fields["body_subtreemass"], model.body_subtreemass, rtol=1e-6)
    np.testing.assert_allclose(fields["body_mass"], model.body_mass, rtol=1e-6)
    np.testing.assert_allclose(fields["body_ipos"], model.body_ipos, atol=1e-7)
    # The payload scales the base link's inertia with its mass.
    heavier = fields["body_inertia"][base.id] / xbot.mj_model.body_inertia[base.id]
    np.testing.assert_allclose(heavier, base.mass / (base.mass - 4.0), rtol=1e-5)


def test_link_randomisation_matches_a_recompiled_model(xbot):
    """Each link has its own mass factor and CoM shift, and the hands carry a load."""
    rng = np.random.default_rng(3)
    factor, shift = rng.uniform(0.9, 1.1, 17), rng.uniform(-0.01, 0.01, (17, 3))
    changed = randomize.nominal(XBOT).replace(
        link_mass=jnp.asarray(factor), link_com=jnp.asarray(shift), hand_mass=jnp.asarray(0.5)
    )
    fields = randomize.model_fields(xbot, changed, GROUND)
    spec = mujoco.MjSpec.from_file(str(description.read(XBOT_L).mjcf))
    names = ["base_link", *(n.replace("joint", "link") for n in xbot.joint_names)]
    for name, f, s in zip(names, factor, shift, strict=True):
        body = spec.body(name)
        before = body.mass
        body.mass = before * f + (0.5 if "elbow" in name else 0.0)
        body.ipos = body.ipos + s
        body.fullinertia = body.fullinertia * body.mass / before
    model = spec.compile()
    for name in ("body_subtreemass", "body_mass", "body_inertia"):
        np.testing.assert_allclose(fields[name], getattr(model, name), rtol=1e-5, err_msg=name)
    np.testing.assert_allclose(fields["body_ipos"], model.body_ipos, atol=1e-7)


def test_a_smaller_sole_is_one_whose_contact_points_move_to_its_middle(xbot):
    """Its points lie 2 cm nearer to the middle along the diagonal, and 0.4 mm higher."""
    drawn = randomize.nominal(XBOT).replace(sole=jnp.full(8, 0.02))
    points = randomize.model_fields(xbot, drawn, GROUND)["geom_pos"][xbot.sole_geom_ids]
    before = xbot.mj_model.geom_pos[xbot.sole_geom_ids]
    middle = np.repeat([before[:4].mean(0), before[4:].mean(0)], 4, axis=0)
    nearer = [np.linalg.norm((p - middle)[:, :2], axis=1) for p in (before, points)]
    np.testing.assert_allclose(nearer[0] - nearer[1], 0.02, atol=1e-5)
    np.testing.assert_allclose(points[:, 2] - before[:, 2], 0.0004, atol=1e-6)


def test_divergence_shows_as_nan_not_as_a_reset():
    """C MuJoCo would reset a diverged simulation silently, and the training could not mask it."""
    step = make_step("mujoco")
    state = standing(PhysicsConfig(engine="mujoco"))
    state = state.replace(qvel=state.qvel.at[3].set(jnp.nan))
    assert not np.all(np.isfinite(step(state, jnp.zeros(16), randomize.nominal(XBOT)).qpos))


def test_a_diverging_robot_leaves_no_file(tmp_path, monkeypatch, capfd):
    """MuJoCo would warn in MUJOCO_LOG.TXT in the present folder."""
    step = make_step("mujoco")
    state = standing(PhysicsConfig(engine="mujoco"))
    state = state.replace(qvel=state.qvel.at[3].set(jnp.nan))
    monkeypatch.chdir(tmp_path)
    seen = []
    try:
        for handler in (seen.append, None):
            mujoco.set_mju_user_warning(handler)
            physics._batch.cache_clear()
            jax.block_until_ready(step(state, jnp.zeros(16), randomize.nominal(XBOT)))
            assert mujoco.get_mju_user_warning() == handler
    finally:
        mujoco.set_mju_user_warning(None)
    assert seen and all(physics.UNSTABLE in x for x in seen)  # the user's handler stays
    assert list(tmp_path.iterdir()) == [] and capfd.readouterr() == ("", "")
    physics._say("Contact buffer is full")
    assert capfd.readouterr().err == "warning: MuJoCo: Contact buffer is full\n"


def test_sensors_are_those_of_the_new_state(xbot):
    """Sensors of the state one physics step before would differ by up to 0.08 in this motion."""
    step, state = make_step("mujoco"), standing(PhysicsConfig(engine="mujoco"))
    for i in range(10):
        target = 0.05 * jnp.sin(2 * jnp.pi * 0.01 * i + jnp.arange(16.0))
        state = step(state, target, randomize.nominal(XBOT))
    data = mujoco.MjData(xbot.mj_model)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    mujoco.mj_forward(xbot.mj_model, data)
    np.testing.assert_allclose(state.sensordata[:-2], data.sensordata[:-2], atol=1e-4)


def test_every_range_is_filled_independently():
    ranges = {
        **{"friction": (0.1, 2.0), "base_mass": (-5.0, 5.0), "base_com": (-0.02, 0.03)},
        **{"kp": (0.8, 1.1), "kd": (0.7, 1.3), "motor_strength": (0.9, 1.0)},
        **{"joint_friction": (0.0, 1.0), "noise": (0.0, 0.5), "hand_mass": (0.0, 0.5)},
        **{"link_mass": (0.9, 1.1), "link_com": (-0.01, 0.01), "sole": (0.0, 0.02)},
    }
    draw = jax.vmap(lambda key: randomize.sample(RandomizeConfig(**ranges), XBOT, key))
    drawn, columns = draw(jax.random.split(jax.random.key(0), 2000)), []
    for name, (low, high) in ranges.items():
        columns.append(np.asarray(getattr(drawn, name)).reshape(2000, -1))
        ends = columns[-1].min(), columns[-1].max()
        np.testing.assert_allclose(ends, [low, high], atol=0.02 * (high - low), err_msg=name)
    apart = np.corrcoef(np.concatenate(columns, 1).T)
    assert np.abs(apart - np.eye(len(apart))).max() < 0.1


def step_with_x64(engine: str) -> None:
    """Traces control steps in a program that enables x64."""
    jax.config.update("jax_enable_x64", True)
    config = PhysicsConfig(engine=engine)
    state = standing(config)
    assert {str(x.dtype) for x in jax.tree.leaves(state)} == {"float32", "float64"}

    def step(s, _):
        return physics.step(config, s, s.qpos[7:], randomize.nominal(XBOT), GROUND), None

    after = jax.eval_shape(lambda s: jax.lax.scan(step, s, None, 2)[0], state)
    assert jax.tree.map(lambda x: x.dtype, after) == jax.tree.map(lambda x: x.dtype, state)
    if engine == "mujoco":  # quickly compiled
        step(state, None)


@pytest.mark.slow(reason="a process of its own")
@pytest.mark.parametrize("engine", ENGINES)
def test_a_program_that_enables_x64_can_step(engine):
    """A script may need float64 for other things. The state keeps its dtypes, so it can be scanned
    over. Traced only: that is where a wrong dtype shows, and compiling takes long.

    In a process of its own: JAX would reuse traces of other tests, which are without x64, and
    without its caches the tests that follow would compile all programs again."""
    code = f"import test_physics; test_physics.step_with_x64({engine!r})"
    command, here = [sys.executable, "-c", code], Path(__file__).parent
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
