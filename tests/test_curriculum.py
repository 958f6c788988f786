"""Curriculum: averages by hand, each gate alone, the paper's steps and limits."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kslc_jax import curriculum
from kslc_jax.config import preset
from kslc_jax.curriculum import Curriculum, Progress
from kslc_jax.training import logs

PAPER = preset("paper")
CONFIG = PAPER.curriculum
# No smoothing: one update is enough to show the gate.
DIRECT = dataclasses.replace(CONFIG, smoothing=0.0)


def state(**changes) -> Curriculum:
    start = curriculum.init(PAPER)
    return start.replace(**{k: jnp.asarray(v, getattr(start, k).dtype) for k, v in changes.items()})


def progress(
    tracking=0.85,
    fast=0.75,
    fast_count=10,
    steps=1500.0,
    count=5,
    settled=100,
    gait=0.7,
    top_deviation=0.0,
    top_scale=40.0,
    top_falls=0.0,
    top_minutes=1.0,
) -> Progress:
    values = (tracking, settled, fast, fast_count, steps, count, gait)
    top = (top_deviation, top_scale, top_falls, top_minutes)
    return Progress(*(jnp.asarray(v, jnp.float32) for v in (*values, *top)))


READY = dict(updates=100)


def test_start():
    start = curriculum.init(PAPER)
    assert float(start.v_max) == 0.5
    assert float(start.cycle_time) == pytest.approx(0.64)
    assert float(start.tracking) == float(start.fast_tracking) == float(start.episode_steps) == 0.0
    assert int(start.updates) == 0


def test_another_trainings_progress_ends_at_the_limits_of_this_one():
    far = state(v_max=4.5, cycle_time=0.38, tracking=0.8)
    here = curriculum.inherit(PAPER, far)
    assert float(here.v_max) == CONFIG.v_limit == 3.5
    assert float(here.cycle_time) == pytest.approx(CONFIG.cycle_min)
    assert float(here.tracking) == pytest.approx(0.8)
    assert (
        float(curriculum.remaining_share(CONFIG, here)) == 0.0
    )  # never negative, because it scales the entropy bonus
    near = curriculum.inherit(PAPER, state(v_max=2.0, cycle_time=0.55))
    assert float(near.v_max) == 2.0 and float(near.cycle_time) == pytest.approx(0.55)
    fixed = preset("paper", ("velocity-curriculum", "cycle-curriculum"))
    here, start = curriculum.inherit(fixed, near), curriculum.init(fixed)
    assert (here.v_max, here.cycle_time) == (start.v_max, start.cycle_time)


def test_averages_by_hand():
    """0.95 old + 0.05 new: 0.05 * 0.8 = 0.04; 0.95 * 0.04 + 0.05 * 0.6 = 0.068. That of the fast
    commands, which starts anew with every range, is a plain mean until it has 20 updates."""
    one = curriculum.update(CONFIG, state(), progress(0.8, 0.4, 3, 200.0, 2))
    assert float(one.tracking) == pytest.approx(0.04)
    assert float(one.fast_tracking) == pytest.approx(0.4)
    assert float(one.episode_steps) == pytest.approx(10.0)
    assert int(one.updates) == 1
    two = curriculum.update(CONFIG, one, progress(0.6, 0.6, 3, 400.0, 1))
    assert float(two.tracking) == pytest.approx(0.068)
    assert float(two.fast_tracking) == pytest.approx(0.5)  # the mean of 0.4 and 0.6
    assert float(two.episode_steps) == pytest.approx(29.5)  # 9.5 + 20
    assert int(two.updates) == 2
    late = curriculum.update(CONFIG, state(updates=30, gait=0.6), progress(gait=0.8))
    assert float(late.gait) == pytest.approx(0.61)  # 0.57 + 0.04


def test_a_shuffle_does_not_open_the_gate():
    strict = dataclasses.replace(DIRECT, gait_threshold=0.65)
    for gait, opens in ((0.64, False), (0.66, True)):
        new = curriculum.update(strict, state(**READY), progress(gait=gait))
        assert (float(new.v_max) > 0.5) == opens
        assert float(new.gait) == (0.0 if opens else pytest.approx(gait))
    assert float(curriculum.update(DIRECT, state(**READY), progress(gait=-0.3)).v_max) == 1.0


@pytest.mark.parametrize(
    ("condition", "poor", "good"),
    [
        ({"gait_threshold": 0.65, "gait_from": 0.75}, {"gait": 0.5}, {"gait": 0.66}),
        (
            {"top_error": 0.05, "top_error_from": 0.75},
            {"top_deviation": -2.1},
            {"top_deviation": -1.9},
        ),
    ],
    ids=["gait", "top error"],
)
def test_the_first_ranges_grow_without_some_conditions(condition, poor, good):
    """Below `gait_from` and `top_error_from` the gate does not look at the gait and the error."""
    strict = dataclasses.replace(DIRECT, **condition)
    first = curriculum.update(strict, state(**READY), progress(**poor))
    assert float(first.v_max) == 1.0
    for seen, v_max in ((poor, 1.0), (good, 1.5)):
        ready = state(**READY).replace(v_max=first.v_max)
        assert float(curriculum.update(strict, ready, progress(**seen)).v_max) == v_max


def test_a_training_says_why_its_range_did_not_grow_to_the_end():
    """Two seeds: one has reached the limit, the other falls and is too slow at its top."""
    config = preset("laptop", ())
    limit = config.curriculum.v_limit
    good = dict(tracking=0.9, fast_tracking=0.8, episode_steps=2000.0, gait=0.8, top_scale=10.0)
    states = (
        state(v_max=limit),
        state(v_max=3.5, **good).replace(
            top_deviation=jnp.float32(-0.6),
            top_falls=jnp.float32(2.0),
            top_minutes=jnp.float32(1.0),
        ),
    )
    both = jax.tree.map(lambda *x: jnp.stack(x), *states)
    (line,) = logs.range_reached(dataclasses.replace(config, seed=3), both)
    assert line == (
        "seed 4: the commands grew to 3.5 of 4 m/s; not good enough at the end: "
        "mean speed under the fastest commands, falls under the fastest commands"
    )
    assert logs.range_reached(config, states[0]) == []
    assert logs.range_reached(config, states[1])[0].startswith(
        "the commands grew to 3.5 of 4 m/s; not"
    )
    assert logs.range_reached(preset("baseline"), states[1]) == []


STRICT = dataclasses.replace(DIRECT, top_error=0.05, top_falls=1.0)


@pytest.mark.parametrize(
    ("seen", "opens"),
    [
        ({"top_deviation": -1.9}, True),
        ({"top_deviation": -2.1}, False),  # 5.25 % too slow
        ({"top_deviation": 2.1}, False),  # 5.25 % too fast
        ({"top_falls": 1.0}, True),
        ({"top_falls": 1.1}, False),
        ({"top_falls": 1.1, "top_minutes": 2.0}, True),
        ({"top_scale": 0.0}, False),  # no robot had a command that fast yet
    ],
    ids=str,
)
def test_a_range_whose_top_is_not_run_does_not_grow(seen, opens):
    new = curriculum.update(STRICT, state(**READY), progress(**seen))
    assert (float(new.v_max) > 0.5) == opens
    assert float(curriculum.update(DIRECT, state(**READY), progress(**seen)).v_max) == 1.0


def test_the_tops_sums_fade_by_hand():
    """1 m/s too slow, then 4 m/s too fast, in sums of 20 m/s each: (0.95 * -1 + 4) / (0.95 * 20 +
    20) = 0.07821. Falls per minute: (0.95 * 2 + 0) / (0.95 * 1 + 1) = 0.97436. A wider range starts
    with empty sums."""
    one = curriculum.update(CONFIG, state(), progress(top_deviation=-1, top_scale=20, top_falls=2))
    two = curriculum.update(CONFIG, one, progress(top_deviation=4, top_scale=20))
    assert float(curriculum.top_error(two)) == pytest.approx(0.07821, abs=1e-5)
    assert float(curriculum.top_falls(two)) == pytest.approx(0.97436, abs=1e-5)
    assert float(curriculum.top_error(state())) == 1.0 and float(curriculum.top_falls(state())) == 0
    wider = curriculum.update(DIRECT, state(**READY), progress(top_falls=3.0))
    assert float(wider.top_deviation) == float(wider.top_scale) == 0.0
    assert float(wider.top_falls) == float(wider.top_minutes) == 0.0


@pytest.mark.parametrize(("vx", "top"), [(1.49, False), (1.51, True), (2.0, True), (-1.9, False)])
def test_the_top_is_the_last_step_of_the_range(vx, top):
    assert bool(curriculum.is_top(CONFIG, state(v_max=2.0), jnp.asarray(vx))) == top


def test_averages_skip_what_was_not_seen():
    """An average without new samples stays: without fast commands, finished episodes, or settled
    commands."""
    old = state(tracking=0.5, fast_tracking=0.6, episode_steps=700.0)
    new = curriculum.update(CONFIG, old, progress(0.7, 0.0, 0, 0.0, 0))
    assert float(new.tracking) == pytest.approx(0.51)
    unsettled = curriculum.update(CONFIG, old, progress(0.0, settled=0))
    assert float(unsettled.tracking) == pytest.approx(0.5)
    assert float(new.fast_tracking) == pytest.approx(0.6)
    assert float(new.episode_steps) == pytest.approx(700.0)


@pytest.mark.parametrize("jit", [False, True])
def test_open_gate_steps_both(jit):
    update = jax.jit(curriculum.update, static_argnums=0) if jit else curriculum.update
    new = update(DIRECT, state(**READY), progress())
    assert float(new.v_max) == 1.0
    assert float(new.cycle_time) == pytest.approx(0.608)
    assert int(new.updates) == 0 and float(new.fast_tracking) == 0.0
    assert float(new.tracking) == pytest.approx(0.85)  # keeps its average
    assert float(new.episode_steps) == pytest.approx(1500.0)


@pytest.mark.parametrize(
    ("closed", "open_"),
    [
        (progress(tracking=0.799), progress(tracking=0.801)),
        (progress(fast=0.699), progress(fast=0.701)),
        (progress(steps=999.0), progress(steps=1000.0)),
    ],
    ids=["tracking", "fast", "episodes"],
)
def test_each_gate_alone_keeps_everything(closed, open_):
    new = curriculum.update(DIRECT, state(**READY), closed)
    assert float(new.v_max) == 0.5 and float(new.cycle_time) == pytest.approx(0.64)
    assert int(new.updates) == 101
    assert float(new.fast_tracking) == pytest.approx(float(closed.fast_tracking))
    assert float(curriculum.update(DIRECT, state(**READY), open_).v_max) == 1.0


@pytest.mark.parametrize(("updates", "v_max"), [(38, 0.5), (39, 1.0), (0, 0.5)])
def test_some_updates_between_two_changes(updates, v_max):
    """The 40th update after a change may be the next change."""
    new = curriculum.update(DIRECT, state(updates=updates), progress())
    assert float(new.v_max) == v_max
    assert int(new.updates) == (0 if v_max == 1.0 else updates + 1)


def test_the_whole_way_of_the_paper():
    """Speed: +0.5 m/s up to 3.5. Cycle: x 0.95 down to 0.48 s; 0.64 * 0.95^6 would be 0.47046."""
    current, speeds, cycles, changes = state(), [], [], 0
    update = jax.jit(curriculum.update, static_argnums=0)
    for _ in range(400):
        new = update(DIRECT, current, progress())
        if float(new.v_max) != float(current.v_max) or float(new.cycle_time) != float(
            current.cycle_time
        ):
            speeds.append(float(new.v_max))
            cycles.append(float(new.cycle_time))
            changes += 1
        current = new
    np.testing.assert_allclose(speeds, [1.0, 1.5, 2.0, 2.5, 3.0, 3.5])
    np.testing.assert_allclose(
        cycles, [0.608, 0.5776, 0.54872, 0.521284, 0.4952198, 0.48], rtol=1e-5
    )
    assert changes == 6
    assert int(current.updates) == 400 - 6 * 40  # at the limits, an open gate is no change
    assert float(current.fast_tracking) == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("velocity", "cycle", "v_max", "cycle_time"),
    [(True, False, 1.0, 0.64), (False, True, 0.5, 0.608), (False, False, 0.5, 0.64)],
)
def test_each_curriculum_can_be_switched_off(velocity, cycle, v_max, cycle_time):
    config = dataclasses.replace(DIRECT, velocity=velocity, cycle=cycle)
    new = curriculum.update(config, state(**READY), progress())
    assert float(new.v_max) == v_max
    assert float(new.cycle_time) == pytest.approx(cycle_time)
    assert int(new.updates) == (0 if velocity or cycle else 101)


def test_the_last_step_stops_at_the_limit():
    new = curriculum.update(DIRECT, state(v_max=3.3, cycle_time=0.5, **READY), progress())
    assert float(new.v_max) == 3.5 and float(new.cycle_time) == pytest.approx(0.48)


@pytest.mark.parametrize(("vx", "fast"), [(1.19, False), (1.21, True), (-1.9, False), (2.0, True)])
def test_fast_commands_are_above_60_percent_of_the_range(vx, fast):
    assert bool(curriculum.is_fast(CONFIG, state(v_max=2.0), jnp.asarray(vx))) == fast


def test_start_average_cannot_open_the_gate_early():
    """The average starts at 0. With tracking 0.85 it passes 0.8 when 0.95^n < 1 - 0.8 / 0.85: after
    56 updates. The fast average and the episode length have passed their gates by then.
    """
    current, n = state(), 0
    update = jax.jit(curriculum.update, static_argnums=0)
    while float(current.v_max) == 0.5 and n < 200:
        current, n = update(CONFIG, current, progress(0.85, 0.85, 10, 2000.0, 5)), n + 1
    assert n == 56


@pytest.mark.parametrize(("v_max", "left"), [(0.5, 1.0), (2.0, 0.5), (3.5, 0.0)])
def test_what_is_left_of_the_way(v_max, left):
    """The share of the range from 0.5 to 3.5 m/s that is still ahead."""
    assert float(curriculum.remaining_share(CONFIG, state(v_max=v_max))) == pytest.approx(left)


def test_without_a_way_all_of_it_is_left():
    config = dataclasses.replace(CONFIG, v_start=3.5)
    assert float(curriculum.remaining_share(config, state(v_max=3.5))) == 1.0
