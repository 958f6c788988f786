"""Drake against C MuJoCo: the same robot, motion in the air, standing height, and sliding."""

import dataclasses
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from states import BIPED, XBOT

from kslc_jax import curriculum, networks, physics, randomize, robot
from kslc_jax import policy as policy_lib
from kslc_jax.config import XBOT_L, ConfigError, HighFidelity, preset
from kslc_jax.evaluation import trials
from kslc_jax.robots import build, description

pytest.importorskip("pydrake", reason="Drake is an optional extra")

from pydrake.multibody.tree import MultibodyForces

from kslc_jax.evaluation import drake

CONFIG = HighFidelity()


def nominal_of(built):
    return jax.tree.map(np.asarray, randomize.nominal(built))


NOMINAL = nominal_of(XBOT)


def world_of(config):
    made = physics.robot_for(config)
    return drake.build(made, made.mj_model)


@pytest.fixture(scope="module")
def world():
    return world_of(CONFIG)


@pytest.fixture(scope="module", params=[XBOT_L, BIPED], ids=["xbot_l", "biped"])
def any_world(request):
    """XBot-L, and a robot with turned frames, joints off their bodies' origins, a bent home."""
    return world_of(HighFidelity(robot=request.param))


def random_state(built, seed):
    rng = np.random.default_rng(seed)
    qpos = np.r_[rng.normal(size=7), rng.uniform(-1, 1, built.count)]
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    return qpos, rng.normal(size=6 + built.count)


def config_of(built):
    return HighFidelity(robot=XBOT_L if built.name == "XBot-L" else BIPED)


def rest(built, qpos, qvel=None):
    """A PhysicsState in float64."""
    qvel = np.zeros(6 + built.count) if qvel is None else qvel
    state = physics.initial_state(config_of(built), jnp.asarray(qpos), jnp.zeros(len(qvel)))
    state = jax.tree.map(lambda x: np.asarray(x, np.float64), state)
    return state.replace(qpos=np.array(qpos), qvel=qvel)


def simulate(world, state, turned=0.0, steps=1):
    """The states after each of `steps` control steps, in Drake and in C MuJoCo.

    All joints are driven to `turned` [rad] from the home pose.
    """
    built, config = world.robot, config_of(world.robot)
    target, nominal = built.default_qpos[7:] + turned, nominal_of(built)
    ours, theirs = [state], [state]
    for _ in range(steps):
        ours.append(drake.advance(world, ours[-1], target, nominal, config.decimation))
        theirs.append(physics._host_step(config, theirs[-1], target, nominal, {}))
    return ours[1:], theirs[1:]


def test_total_mass(any_world):
    total = any_world.plant.CalcTotalMass(any_world.plant_context)
    assert total == pytest.approx(any_world.robot.total_mass, rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_links_and_mass_matrix_agree_at_random_poses(any_world, seed):
    """Positions agree to 1e-9 m. The mass matrix, in MuJoCo's coordinates, agrees to 1e-9 of its
    largest element."""
    world = any_world
    model, data = world.data.model, mujoco.MjData(world.data.model)
    data.qpos[:], data.qvel[:] = random_state(world.robot, seed)
    mujoco.mj_forward(model, data)
    drake.set_state(world, data.qpos, data.qvel)
    for name, back in zip(("qpos", "qvel"), drake.get_state(world), strict=True):
        np.testing.assert_allclose(back, getattr(data, name), atol=1e-12)
    for i in range(1, model.nbody):
        link = world.plant.GetBodyByName(model.body(i).name)
        position = world.plant.EvalBodyPoseInWorld(world.plant_context, link).translation()
        np.testing.assert_allclose(position, data.xpos[i], atol=1e-9)
    theirs = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, theirs)
    # Drake's velocities are turned @ qvel: it has the base's angular velocity in the world frame.
    turned = np.eye(model.nv)
    mujoco.mju_quat2Mat(flat := np.zeros(9), data.qpos[3:7])
    turned[3:6, 3:6] = flat.reshape(3, 3)
    ours = world.plant.CalcMassMatrix(world.plant_context)[np.ix_(world.v_index, world.v_index)]
    np.testing.assert_allclose(turned.T @ ours @ turned, theirs, atol=1e-9 * theirs.max())


def test_free_fall_is_exact(any_world):
    """From rest, semi-implicit Euler gives z = z0 - g dt^2 n (n + 1) / 2 in both engines."""
    world = any_world
    qpos = world.robot.default_qpos.copy()
    qpos[2] = 5.0
    n, dt = 200, CONFIG.timestep
    expected = 5.0 - 9.81 * dt**2 * n * (n + 1) / 2
    for states in simulate(world, rest(world.robot, qpos), steps=n // CONFIG.decimation):
        assert states[-1].qpos[2] == pytest.approx(expected, abs=1e-5)  # C MuJoCo's is float32
        np.testing.assert_allclose(states[-1].qpos[7:], qpos[7:], atol=1e-5)


def test_tumbling_with_driven_joints_agrees(any_world):
    """0.2 s of rotation in the air, with all joints driven by 0.3 rad. Tests inertia, motors and
    joint friction."""
    world = any_world
    qpos = world.robot.default_qpos.copy()
    qpos[2] = 5.0
    qvel = np.r_[1.0, 0.5, 2.0, 1.0, -2.0, 1.5, np.zeros(world.robot.count)]
    ours, theirs = simulate(world, rest(world.robot, qpos, qvel), turned=0.3, steps=20)
    np.testing.assert_allclose(ours[-1].qpos, theirs[-1].qpos, atol=5e-3)
    np.testing.assert_allclose(ours[-1].sensordata, theirs[-1].sensordata, atol=0.1)


def test_dropped_on_its_feet_it_rests_at_the_same_height(any_world):
    """A drop from 2 cm with active servos. From 0.2 s on, the heights agree within 5 mm; then the
    feet carry the weight."""
    world = any_world
    qpos = world.robot.default_qpos.copy()
    qpos[2] = world.robot.stand_height + 0.02
    ours, theirs = simulate(world, rest(world.robot, qpos), steps=60)
    apart = [a.qpos[2] - b.qpos[2] for a, b in zip(ours, theirs, strict=True)]
    assert np.abs(apart[20:]).max() < 0.005
    touch = np.r_[[world.robot.sensor(name).start for name in drake.TOUCH_SENSORS]]
    load = np.mean([state.sensordata[touch].sum() for state in ours[30:]])
    assert load == pytest.approx(9.81 * world.robot.total_mass, rel=0.05)


def test_low_friction_slides(world):
    """The robot lands at 0.3 m/s sideways. With friction 0.05 its feet slide about 2 cm in 0.2 s in
    both engines; with 1.0 they slide less than 5 mm."""
    qpos = world.robot.default_qpos.copy()
    qpos[2] = 0.885
    state = rest(world.robot, qpos, np.r_[0.0, 0.3, np.zeros(20)])
    slid = {}
    for mu in (0.05, 1.0):
        fields = randomize.model_fields(world.robot, randomize.nominal(XBOT, mu), mu)
        fields = jax.tree.map(lambda x: np.asarray(x, np.float64), fields)
        for engine, step in (("drake", drake._host_step), ("mujoco", physics._host_step)):
            now = state
            for _ in range(20):
                now = step(CONFIG, now, np.zeros(16), NOMINAL, fields)
            slid[engine, mu] = now.sensordata[world.robot.sensor("left_foot_pos")][1]
    start = 0.117  # y of the left foot
    assert slid["drake", 0.05] == pytest.approx(slid["mujoco", 0.05], abs=2e-3)
    for engine in ("drake", "mujoco"):
        assert slid[engine, 0.05] - start > 0.017
        assert abs(slid[engine, 1.0] - start) < 0.005


def test_step_is_physics_step(world):
    """Under jit and vmap, with different payloads: shapes are right, and each environment gives the
    same numbers as alone."""
    step = jax.jit(
        jax.vmap(lambda s, d: drake.step(CONFIG, s, jnp.zeros(16), d, 1.0), in_axes=(None, 0))
    )
    start = physics.initial_state(CONFIG, jnp.asarray(world.robot.default_qpos), jnp.zeros(22))
    heavy = randomize.nominal(XBOT).replace(base_mass=jnp.array(5.0))
    both = step(start, jax.tree.map(lambda *x: jnp.stack(x), randomize.nominal(XBOT), heavy))
    assert jax.tree.map(lambda x: x.shape[1:], both) == jax.tree.map(jnp.shape, start)
    for i, dynamics in enumerate((randomize.nominal(XBOT), heavy)):
        fields = randomize.model_fields(world.robot, dynamics, 1.0)
        one = drake._host_step(CONFIG, start, np.zeros(16), dynamics, fields)
        for a, b in zip(jax.tree.leaves(both), jax.tree.leaves(one), strict=True):
            # The jitted program rounds the model's fields in another way than the eager one.
            np.testing.assert_allclose(a[i], b, rtol=0, atol=1e-12)


def test_a_diverged_step_shows_as_nan(world):
    state = rest(world.robot, world.robot.default_qpos, np.r_[np.nan, np.zeros(21)])
    assert np.isnan(drake.advance(world, state, np.zeros(16), NOMINAL, 1).qpos).any()


def test_servos_alone_stand_a_second_in_drake():
    """A policy runs in a trial: environment, signals, observations, trace."""
    config = preset("debug")
    params = jax.tree.map(np.zeros_like, networks.init(config, jax.random.key(0)))
    still = policy_lib.Policy(config, params, curriculum.init(config), 0)
    setting = trials.Setting(CONFIG, seconds=1.0, simulate=drake.step)
    trace = trials.join(list(trials.run(still, setting, np.zeros((1, 3)))))
    assert trace.alive[:80].all() and trace.contact[30:80].mean() > 0.9
    assert 0.8 < trace.qpos[50, 0, 2] < 0.9


def test_a_foot_of_several_shapes_carries_the_weight(tmp_path):
    """The left foot has two boxes side by side, the right one a mesh of the same outline."""
    xml = Path(BIPED).with_suffix(".xml").read_text()
    half = '<geom type="box" size="0.08 0.015 0.01" pos="0.02 {y} -0.03"/>'
    left = '<geom name="left_foot" type="box" size="0.08 0.03 0.01" pos="0.02 0 -0.03"/>'
    right = '<geom type="box" size="0.08 0.03 0.01" pos="-0.02 0 -0.03"/>'
    corners = [f"{x} {y} {z}" for x in (-0.08, 0.08) for y in (-0.03, 0.03) for z in (-0.01, 0.01)]
    mesh = f'<asset><mesh name="shoe" vertex="{" ".join(corners)}"/></asset>'
    assert left in xml and right in xml
    xml = xml.replace(left, half.format(y=0.015) + half.format(y=-0.015))
    xml = xml.replace(right, '<geom type="mesh" mesh="shoe" pos="-0.02 0 -0.03"/>')
    (tmp_path / "biped.xml").write_text(xml.replace("<worldbody>", mesh + "<worldbody>"))
    shutil.copy(BIPED, tmp_path)
    config = HighFidelity(robot=str(tmp_path / "biped.toml"))
    other = world_of(config)
    assert [len(foot) for foot in other.feet] == [2, 1]
    qpos = other.robot.default_qpos.copy()
    qpos[2] = other.robot.stand_height + 0.002
    state = physics.initial_state(config, jnp.asarray(qpos), jnp.zeros(6 + other.robot.count))
    state = jax.tree.map(lambda x: np.asarray(x, np.float64), state).replace(qpos=qpos)
    touch, loads = [other.robot.sensor(name).start for name in drake.TOUCH_SENSORS], []
    for _ in range(20):
        args = qpos[7:], nominal_of(other.robot), config.decimation
        state = drake.advance(other, state, *args)
        loads.append(state.sensordata[touch])
    weight = 9.81 * other.robot.total_mass
    both = np.mean(loads[8:], axis=0)
    assert both.sum() == pytest.approx(weight, rel=0.15) and both.min() > 0.3 * weight


def test_two_joints_in_one_body_are_refused():
    spec = build.spec(description.read(BIPED), "high")
    name = spec.body("port_keel").name
    spec.body(name).add_joint(name="second", axis=[1, 0, 0], range=[-1, 1])
    twice = dataclasses.replace(robot.load("high", name=BIPED), mj_model=spec.compile())
    with pytest.raises(ConfigError, match="'port_keel' of biped has 2: take --engine mujoco"):
        drake.require_hinged(twice)


def test_a_bent_zero_and_a_spring_agree(tmp_path):
    """The MJCF's pose is at an angle of 0.3 rad, and a spring pulls: as `ref` and `springref`."""
    spec = mujoco.MjSpec.from_file(str(Path(BIPED).with_suffix(".xml")))
    for side, sign in (("port", 1.0), ("star", -1.0)):
        lock = spec.joint(f"{side}_lock")
        lock.ref, lock.springref, lock.stiffness = sign * 0.3, sign * -0.2, [7.0, 0.0, 0.0]
    home = np.array(spec.key("bent").qpos)
    home[[10, 14]] += 0.3, -0.3  # the same pose, with level feet
    spec.key("bent").qpos = home
    (tmp_path / "biped.xml").write_text(spec.to_xml())
    shutil.copy(BIPED, tmp_path)
    config = HighFidelity(robot=str(tmp_path / "biped.toml"))
    bent = world_of(config)
    model, data = bent.data.model, mujoco.MjData(bent.data.model)
    data.qpos[:], _ = random_state(bent.robot, 0)  # at rest: Drake adds the damping
    mujoco.mj_forward(model, data)
    drake.set_state(bent, data.qpos, data.qvel)
    for i in range(1, model.nbody):
        link = bent.plant.GetBodyByName(model.body(i).name)
        position = bent.plant.EvalBodyPoseInWorld(bent.plant_context, link).translation()
        np.testing.assert_allclose(position, data.xpos[i], atol=1e-9)
    joint = bent.plant.GetJointByName("port_lock")
    forces = MultibodyForces(bent.plant)
    bent.plant.CalcForceElementsContribution(bent.plant_context, forces)
    spring = forces.generalized_forces()[joint.velocity_start()]
    assert spring == pytest.approx(data.qfrc_spring[model.joint("port_lock").dofadr[0]])
