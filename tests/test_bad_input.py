"""Bad input to the commands: exit code 2, one line that names the error, no traceback, and no
change on disk."""

import contextlib
import copy
import errno
import io
import json
import os
import re
import string
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import family
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

import kslc_jax.evaluation
from kslc_jax import (
    cli,
    compare,
    doctor,
    evaluate,
    export,
    falls,
    files,
    judge,
    learning,
    play,
    plots,
    reproduce,
    sim2sim,
    train,
    train_step,
)
from kslc_jax import policy as policy_lib
from kslc_jax.checkup import report
from kslc_jax.config import PRESETS, ConfigError, preset, to_dict
from kslc_jax.training import checkpoint

few = settings(
    max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
words = st.text(string.ascii_letters, min_size=4, max_size=8).filter(
    lambda w: w.lower() != "infinity"
)


def refused(main, *argv: Any) -> str:
    """The text on stderr of a command that must refuse its arguments."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(a) for a in argv])
        except SystemExit as stop:  # tyro raises it
            code = stop.code
    said = err.getvalue()
    assert code == 2 and "Traceback" not in said
    if said.startswith("error: "):  # else tyro printed a box: unknown options
        assert len(said.splitlines()) == 1
    return said


@pytest.fixture(autouse=True)
def no_training(monkeypatch):
    """Replaces the train step by None. If a command accepts bad input, it fails with an
    AttributeError."""
    monkeypatch.setattr(
        train_step, "make", lambda config: (lambda: train_step.init(config, config.seed), None)
    )


@pytest.fixture
def run_dir(tmp_path):
    """An empty folder whose name has a space, quotes and characters beyond ASCII."""
    folder = tmp_path / "läuft gut 机器人 'x'"
    folder.mkdir()
    return folder


# ----------------------------------------------------------------------------------------- options

SIZES = ["env.num-envs", "ppo.rollout-steps", "env.frames", "env.privileged-frames"]
COUNTS = [*SIZES, "ppo.minibatches", "ppo.epochs", "run.steps", "run.keep", "physics.decimation"]
FLOATS = [
    *("ppo.gamma", "env.episode-seconds", "gait.cycle-time", "rewards.weights.joint-pos"),
    *("physics.timestep", "command.resample-seconds", "run.checkpoint-minutes", "env.action-scale"),
]


class TestTrain:
    def refused(self, folder: Path, *argv: Any) -> str:
        said = refused(train.main, "--preset", "debug", "--run-dir", folder / "new", *argv)
        assert not (folder / "new").exists()
        return said

    @few
    @given(st.sampled_from(COUNTS), st.integers(-(2**70), 0))
    def test_no_positive_count(self, run_dir, name, value):
        assert name.replace("-", "_") in self.refused(run_dir, f"--{name}", value)

    @settings(few, max_examples=3)  # each traces a training
    @given(st.sampled_from([*SIZES, "network.actor"]), st.integers(2**34, 2**70))
    @example("env.num-envs", 2**40)
    @example("env.privileged-frames", 2**63 // 100)  # 50 numbers a frame: 2^63 inputs
    def test_sizes_beyond_any_memory(self, run_dir, name, value):
        said = self.refused(run_dir, f"--{name}", 2 * value)
        assert name.replace("-", "_") in said or "network sizes" in said

    @few
    @given(st.sampled_from(FLOATS), st.sampled_from(["nan", "inf", "-inf", "1e300"]))
    def test_floats_out_of_bounds(self, run_dir, name, value):
        assert name.replace("-", "_") in self.refused(run_dir, f"--{name}={value}")

    @few
    @given(st.sampled_from([*COUNTS, *FLOATS, "network.actor"]), words)
    def test_words_for_numbers(self, run_dir, name, word):
        assert f"--{name}" in self.refused(run_dir, f"--{name}", word)

    @few
    @given(words.filter(lambda w: w not in PRESETS))
    def test_unknown_names(self, run_dir, word):
        assert word in refused(train.main, "--preset", word, "--run-dir", run_dir / "new")
        assert word in self.refused(run_dir, "--without", word)
        assert word in self.refused(run_dir, f"--of-{word}", "1")  # "--seed" would be an option
        assert word in self.refused(run_dir, "--physics.engine", word)

    def test_profile_and_devices(self, run_dir):
        assert "--profile: -1" in self.refused(run_dir, "--profile", -1)
        assert "--profile" in self.refused(run_dir, "--profile", "few")
        assert "--devices: 0 asked for" in self.refused(run_dir, "--devices", 0)
        assert "--devices: 99 asked for" in self.refused(run_dir, "--devices", 99)
        assert "--devices" in self.refused(run_dir, "--devices", "few")

    @pytest.mark.parametrize(
        "options",
        [
            ("--coordinator", "localhost:1234"),
            ("--coordinator", "localhost:1234", "--processes", 2),
            ("--coordinator", "localhost:1234", "--process-index", 0),
            ("--coordinator", "localhost", "--processes", 2, "--process-index", 0),
            ("--coordinator", "localhost:1234", "--processes", "two", "--process-index", 0),
            ("--coordinator", "localhost:1234", "--processes", 2, "--process-index", -1),
            ("--coordinator", "auto", "--processes", 2),
            ("--processes", 2, "--process-index", 0),
            ("--process-index", 1),
        ],
    )
    def test_processes_that_do_not_say_who_they_are(self, run_dir, options):
        assert "--coordinator host:port, --processes N" in self.refused(run_dir, *options)

    def test_processes_that_cannot_be(self, run_dir):
        assert train.cluster("localhost:1234", "2e0", "1_0e-1") == ("localhost:1234", 2, 1)
        where = ("--coordinator", "localhost:1234", "--processes", 2, "--process-index", 2)
        assert "--process-index: 2 is too large" in self.refused(run_dir, *where)
        assert "--coordinator auto, with the scheduler's settings: cannot join" in self.refused(
            run_dir, "--coordinator", "auto"
        )

    def test_impossible_folder(self, tmp_path):
        folder = tmp_path / ("x" * 300)
        assert "cannot write" in refused(train.main, "--preset", "debug", "--run-dir", folder)
        assert "cannot read" in refused(train.main, "--resume", "--run-dir", folder)

    def test_seed_beyond_the_counter(self, run_dir):
        assert "seed" in self.refused(run_dir, "--seed", 2**40)


# ---------------------------------------------------------------------------------- stored configs


def places(tree: dict[str, Any], at: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths to every value of nested dicts."""
    for name, value in tree.items():
        yield (*at, name)
        if isinstance(value, dict):
            yield from places(value, (*at, name))


STORED = to_dict(preset("debug"))


class TestStoredConfig:
    def refused(self, folder: Path, content: bytes) -> str:
        path = folder / "config.json"
        path.write_bytes(content)
        said = refused(train.main, "--resume", "--run-dir", folder)
        assert path.read_bytes() == content and list(folder.iterdir()) == [path]
        return said

    @settings(few, max_examples=30)
    @given(st.sampled_from(sorted(places(STORED))), st.sampled_from([None, {}, [[]], "word"]))
    def test_wrong_type(self, run_dir, where, junk):
        data = copy.deepcopy(STORED)
        inner = data
        for name in where[:-1]:
            inner = inner[name]
        assume(not (junk == {} and isinstance(inner[where[-1]], dict)))  # {}: all defaults
        inner[where[-1]] = junk
        assert where[-1] in self.refused(run_dir, json.dumps(data).encode())

    @settings(few, max_examples=30)
    @given(st.sampled_from(sorted(places(STORED))))
    def test_unknown_field(self, run_dir, where):
        data = copy.deepcopy(STORED)
        inner = data
        for name in where[:-1]:
            inner = inner[name]
        inner[f"{where[-1]}x"] = inner.pop(where[-1])
        assert where[-1] in self.refused(run_dir, json.dumps(data).encode())

    @settings(few, max_examples=30)
    @given(st.binary(max_size=40) | st.sampled_from([b"", b"[]", b"1", b"null", b"[" * 10**5]))
    def test_no_json(self, run_dir, content):
        assert "config" in self.refused(run_dir, content)

    @settings(few, max_examples=30)
    @given(st.integers(0, len(json.dumps(STORED)) - 1))
    def test_cut_off(self, run_dir, length):
        said = self.refused(run_dir, json.dumps(STORED).encode()[:length])
        assert "config.json is damaged" in said


# ------------------------------------------------------------------------------- the other commands


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A run folder with one checkpoint of zeros. Its path has a space and non-ASCII characters."""
    config = preset("debug")

    def zeros(x):
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return jax.random.key(0) if is_key else jnp.zeros(x.shape, x.dtype)

    state = jax.tree.map(zeros, jax.eval_shape(lambda: train_step.init(config, 0)))
    folder = tmp_path_factory.mktemp("run ünïcode 机器人")
    with contextlib.closing(checkpoint.Store(folder)) as store:
        metrics = {"score": 0.0, "step": 0, "curriculum/v_max": 0.5, "curriculum/cycle_time": 0.64}
        store.save(state, config, metrics)
    return folder


def test_policy_loads_from_a_path_with_anything_in_it(policy):
    assert policy_lib.load_policy(policy).config == preset("debug")


PICTURE = ("--gait-strip", "strip.png")
COMMANDS = [(evaluate.main, ()), (sim2sim.main, ()), (play.main, PICTURE)]
NAMES = ["evaluate", "sim2sim", "play"]


@pytest.fixture
def any_renderer(monkeypatch):
    """Sets a renderer. Tests of bad input draw nothing, so the machine need not have it."""
    monkeypatch.setenv("MUJOCO_GL", "egl")


@pytest.mark.usefixtures("any_renderer")
@pytest.mark.parametrize(("main", "more"), COMMANDS, ids=NAMES)
class TestTrialOptions:
    @few
    @given(word=words)
    def test_words_for_numbers(self, main, more, policy, word):
        for name in ("speeds", "seconds"):
            assert f"--{name}" in refused(main, policy, *more, f"--{name}", word)

    @pytest.mark.parametrize("value", [0, -1, "nan", "inf"])
    def test_seconds(self, main, more, policy, value):
        assert "seconds" in refused(main, policy, *more, f"--seconds={value}")

    def test_no_speeds(self, main, more, policy):
        assert "speeds" in refused(main, policy, *more, "--speeds")

    def test_speed_is_no_number(self, main, more, policy):
        assert "speeds" in refused(main, policy, *more, "--speeds", "1.0", "nan")


@pytest.mark.usefixtures("any_renderer")
@pytest.mark.parametrize(
    ("main", "more"),
    [*COMMANDS, (judge.main, ()), (falls.main, ())],
    ids=[*NAMES, "judge", "falls"],
)
class TestPolicyAndSeed:
    @few
    @given(word=words)
    def test_words_for_a_seed(self, main, more, policy, word):
        assert "--seed" in refused(main, policy, *more, "--seed", word)

    @pytest.mark.parametrize("value", [-1, 2**31, 10**20])
    def test_seed(self, main, more, policy, value):
        assert "seed" in refused(main, policy, *more, f"--seed={value}")

    def test_nothing_there(self, main, more, tmp_path):
        missing = tmp_path / "nicht da 空"
        assert str(missing) in refused(main, missing, *more)

    def test_no_policy(self, main, more, tmp_path):
        (tmp_path / "params").mkdir()
        (tmp_path / "params" / "x").write_bytes(b"\x80\x04junk")
        assert str(tmp_path) in refused(main, tmp_path, *more)


def test_a_disk_that_fills_up_in_the_end_is_named_and_the_old_numbers_stay(tmp_path, monkeypatch):
    kept = tmp_path / "kept.json"
    files.write_json(kept, {"rows": [1]})
    with pytest.raises(ConfigError, match="/dev/full: No space left"):
        files.write_json(Path("/dev/full"), {"rows": [2]})

    def full(self, text):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(ConfigError, match=r"kept\.json: No space left"):
        files.write_json(kept, {"rows": [2]})
    assert json.loads(kept.read_text()) == {"rows": [1]}


@pytest.mark.parametrize("name", family.COMMANDS)
def test_usage_is_what_is_typed(name, capsys):
    with pytest.raises(SystemExit):
        family.main(name)(["--help"])
    assert f"usage: python -m kslc_jax.{name} " in capsys.readouterr().out


@pytest.mark.parametrize(("main", "figure"), [(learning.main, []), (plots.main, ["performance"])])
def test_at_least_one_path_is_asked_for(main, figure, capsys):
    with pytest.raises(SystemExit):
        main([*figure, "--help"])
    assert " PATH [PATH ...] " in capsys.readouterr().out
    assert "name at least one" in refused(main, *figure)


@pytest.mark.parametrize(
    ("main", "argv", "said"),
    [
        (train.main, ["--steps", "1e3.5"], "--steps: '1e3.5' is not a whole number, such as"),
        (train.main, ["--steps", "nan"], "--steps: 'nan' is not a whole number, such as"),
        (train.main, ["--ppo.gamma", "x"], "--ppo.gamma: could not convert string to float"),
        (train.main, ["--run-dir"], "Missing value for argument '--run-dir'"),
        (train.main, ["--physics.engine", "x"], "invalid choice 'x' for argument '--physics.en"),
        (play.main, ["d", "--port", "x"], "--port: 'x' is not a whole number, such as"),
        (play.main, [], "Missing from python -m kslc_jax.play: PATH"),
    ],
)
def test_a_value_that_cannot_be_read_is_one_line(main, argv, said):
    assert refused(main, *argv).startswith(f"error: {said}")


def test_a_box_without_utf8_and_with_colours_is_one_line_too():
    rule = f" {'-' * 40} "
    box = [
        " Value error ",
        rule,
        "  \x1b[1mError parsing --n:\x1b[0m no",
        "  number  ",
        rule,
        "  help",
    ]
    assert cli._message("\n".join(box)) == "--n: no number"


def test_what_a_link_points_to_is_written(tmp_path):
    link, target = tmp_path / "latest.json", tmp_path / "there" / "kept.json"
    link.symlink_to(target)
    for rows in ([1], [2]):  # first a new file in a new folder, then an existing one
        files.write_json(link, {"rows": rows})
        assert link.is_symlink() and json.loads(target.read_text()) == {"rows": rows}
    assert list(target.parent.iterdir()) == [target]


def test_numbers_are_not_lost_to_a_link_that_leads_to_itself(tmp_path):
    link = tmp_path / "latest.json"
    link.symlink_to(link)
    files.require_writable(link)
    files.write_json(link, {"rows": [1]})
    assert json.loads(link.read_text()) == {"rows": [1]}


WRITERS = {
    "evaluate": "evaluate xbot_l_run --json OUT.json",
    "sim2sim": "sim2sim xbot_l_run --json OUT.json",
    "judge": "judge xbot_l_run --json OUT.json",
    "falls": "falls xbot_l_run --json OUT.json",
    "strip": "play xbot_l_run --gait-strip OUT.png",
    "video": "play xbot_l_run --video OUT.webp",
    "export": "export xbot_l_run OUT.onnx",
    "data": "export xbot_l_run OUT.json/../a.onnx",  # a.json, beside the network
    "orbax": "export xbot_l_run OUT.d --format orbax",
    "doctor": "doctor robot xbot_l --picture OUT.png",
    "compare": "compare --out OUT.d",
    "keep": "compare --keep OUT.d",
    "reproduce": "reproduce --train --run-dir OUT.d",
    "learning": "learning OUT.d",
}
"""Commands that work for long and then write OUT. An OUT.d is a folder to make."""


class TestResults:
    """Files that commands write. What cannot be written is told before the work."""

    @pytest.fixture(autouse=True)
    def no_work(self, monkeypatch, tmp_path):
        """Commands that begin to work fail with another error."""

        def late(*_: Any, **__: Any) -> Any:
            raise AssertionError("the work begins")

        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(policy_lib, "load_policy", late)
        monkeypatch.setattr(compare, "run_all", late)
        monkeypatch.setattr(report, "check", late)
        monkeypatch.setattr(learning, "curve", late)
        monkeypatch.setattr(learning, "snapshots", lambda run: [])

    def argv(self, name: str, out: Path | str) -> tuple[Any, list[str]]:
        command, *argv = WRITERS[name].split()
        return family.main(command), [x.replace("OUT", str(out)) for x in argv]

    @pytest.mark.parametrize("name", WRITERS)
    def test_below_a_file(self, name, tmp_path):
        (tmp_path / "file").touch()
        main, argv = self.argv(name, "file/x")
        assert "cannot write file/x" in refused(main, *argv)

    @pytest.mark.parametrize("name", WRITERS)
    def test_a_folder_or_a_file_in_its_place(self, name, tmp_path):
        main, argv = self.argv(name, "x")
        for suffix in ("json", "png", "webp", "onnx"):
            (tmp_path / f"x.{suffix}").mkdir()
        (tmp_path / "a.json").mkdir()
        (tmp_path / "x.d").touch()
        assert re.search(r"cannot write (x|a)\.|a\.json", refused(main, *argv))

    @pytest.mark.parametrize("name", WRITERS)
    def test_a_name_too_long(self, name):
        main, argv = self.argv(name, "x" * 300)
        assert "File name too long" in refused(main, *argv)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    @pytest.mark.parametrize("name", WRITERS)
    def test_a_folder_that_cannot_be_written(self, name, tmp_path):
        (tmp_path / "mine").mkdir(mode=0o555)
        main, argv = self.argv(name, "mine/x")
        assert "Permission denied" in refused(main, *argv)

    @pytest.mark.parametrize(
        "where", ["there/is/none/x", "../up/x", "with space/läuft 机器人/x", "link/x"]
    )
    @pytest.mark.parametrize("name", WRITERS)
    def test_any_other_path(self, name, where, tmp_path):
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
        main, argv = self.argv(name, where)
        with pytest.raises(AssertionError, match="the work begins"):
            main(argv)
        left = [path for path in tmp_path.parent.rglob("*") if path.is_file()]
        assert not [path for path in left if ".part" in path.name]

    def test_the_old_file_survives_an_error_and_ctrl_c(self, tmp_path):
        old = tmp_path / "x.png"
        old.write_text("old")
        for error in (KeyboardInterrupt, OSError(errno.ENOSPC, "No space left on device")):
            with pytest.raises((KeyboardInterrupt, ConfigError)), files.saving(old) as part:
                part.write_text("half")
                raise error
            assert old.read_text() == "old" and list(tmp_path.iterdir()) == [old]

    def test_a_file_that_can_be_written_in_a_folder_that_cannot(self, tmp_path, monkeypatch):
        """The new content needs a second file beside it."""

        def denied(path: Path) -> None:
            raise PermissionError(errno.EACCES, "Permission denied")

        (tmp_path / "x.json").touch()
        monkeypatch.setattr(Path, "touch", denied)
        with pytest.raises(ConfigError, match=r"x\.json: Permission denied"):
            files.require_writable(tmp_path / "x.json")

    @pytest.mark.parametrize("out", ["p.json", "p.xml", "p.npz"])
    def test_a_network_with_the_name_of_its_data(self, out):
        said = refused(export.main, "xbot_l_run", out, "--format", "onnx")
        assert f"{out} has the name of a file that is written beside it" in said

    @pytest.mark.parametrize("out", ["curve", "curve.xyz"])
    def test_a_figure_without_a_suffix(self, out, tmp_path):
        assert "must end in .png" in refused(plots.main, "training", tmp_path, "--out", out)
        assert "must end in .png" in refused(doctor.main, "robot", "xbot_l", "--picture", out)


class TestPlay:
    @few
    @given(word=words, option=st.sampled_from(["--gait-strip", "--video"]))
    def test_suffix(self, policy, run_dir, word, option):
        assert word in refused(play.main, policy, option, run_dir / f"x.{word}")

    def test_drake_is_not_installed(self, monkeypatch, tmp_path):
        """The command says so before it looks for the policy."""
        monkeypatch.setitem(sys.modules, "kslc_jax.evaluation.drake", None)
        monkeypatch.delattr(kslc_jax.evaluation, "drake", raising=False)
        assert "kslc_jax[drake]" in refused(play.main, tmp_path, *PICTURE, "--engine", "drake")

    def test_drake_has_no_training_engine(self, policy):
        said = refused(play.main, policy, *PICTURE, "--engine", "drake", "--fidelity", "train")
        assert "--fidelity high" in said


class TestExport:
    @few
    @given(word=words)
    def test_suffix(self, policy, run_dir, word):
        assert word in refused(export.main, policy, run_dir / f"policy.{word}")
        assert list(run_dir.iterdir()) == []

    def test_nothing_there(self, run_dir):
        assert "nicht da" in refused(export.main, "nicht da", run_dir / "policy.onnx")

    def test_nowhere_to_write(self, policy, run_dir):
        (run_dir / "file").touch()
        out = run_dir / "file" / "policy.onnx"
        assert str(out) in refused(export.main, policy, out)


class TestCompare:
    @few
    @given(words, st.sampled_from(["variants", "preset", "baseline", "seeds", "speeds", "steps"]))
    def test_words(self, run_dir, word, name):
        said = refused(compare.main, "--out", run_dir / "new", f"--{name}", word)
        assert word in said and not (run_dir / "new").exists()

    @few
    @given(st.integers(-(2**40), 0), st.sampled_from(["steps", "snapshots", "trials"]))
    def test_no_positive_count(self, run_dir, value, name):
        assert name in refused(compare.main, "--out", run_dir / "new", f"--{name}", value)

    @pytest.mark.parametrize("name", ["seeds", "ablation-seeds"])
    def test_seeds(self, run_dir, name):
        for seed in (-1, 2**31):
            said = refused(compare.main, "--out", run_dir / "new", f"--{name}", 0, seed)
            assert name.replace("-", "_") in said


class TestLearning:
    def test_no_run(self, run_dir):
        assert "name at least one run" in refused(learning.main)
        assert "holds no snapshots" in refused(learning.main, run_dir)

    def test_damaged_snapshot(self, run_dir):
        (run_dir / "snapshots" / "7" / "params").mkdir(parents=True)
        assert str(run_dir / "snapshots" / "7") in refused(learning.main, run_dir)

    @pytest.mark.parametrize("option", ["--seconds=nan", "--seeds=0", "--speeds=fast"])
    def test_options(self, run_dir, option):
        assert option[2:].split("=")[0] in refused(learning.main, run_dir, option)


class TestReproduce:
    @few
    @given(words)
    def test_unknown_policy(self, word):
        assert word in refused(reproduce.main, word)

    @pytest.mark.parametrize("seed", [-1, 2**31, "one"])
    def test_seed(self, seed):
        assert "seed" in refused(reproduce.main, "--seed", seed)

    def test_not_a_shipped_one(self, policy):
        assert "only shipped policies" in refused(reproduce.main, policy)


class TestPlots:
    @pytest.mark.parametrize("figure", ["training", "learning", "performance", "momentum"])
    def test_no_files(self, figure):
        assert "name at least one" in refused(plots.main, figure)

    def test_rows_without_a_command(self, run_dir):
        (run_dir / "evaluation.json").write_text('{"rows": [{"survival": 1.0}]}')
        said = refused(plots.main, "momentum", run_dir / "evaluation.json")
        assert "is no evaluation" in said

    def rows(self, folder: Path, content: bytes) -> Path:
        (folder / "metrics.jsonl").write_bytes(content)
        return folder

    @few
    @given(st.binary(max_size=40))
    def test_no_metrics(self, run_dir, content):
        folder = self.rows(run_dir, content)
        out = run_dir / "curve.png"
        said = refused(plots.main, "training", folder, "--out", out)
        assert str(folder) in said and not out.exists()

    @pytest.mark.parametrize("content", [b"1\n", b"{}\n", b'{"curriculum/v_max": "x"}\n'])
    def test_other_json(self, run_dir, content):
        folder = self.rows(run_dir, content)
        assert str(folder) in refused(plots.main, "training", folder, "--out", run_dir / "c.png")

    def test_nowhere_to_write(self, run_dir):
        columns = ["step", "env_steps", "seconds", *(name for name, _, _ in plots.PANELS)]
        row = json.dumps(dict.fromkeys(columns, 1.0)).encode()
        folder = self.rows(run_dir, row + b"\n" + row + b"\n")
        out = folder / "metrics.jsonl" / "curve.png"
        assert str(out.parent) in refused(plots.main, "training", folder, "--out", out)


class TestDoctor:
    @few
    @given(st.binary(max_size=40))
    def test_no_dump(self, run_dir, content):
        (run_dir / "d.npz").write_bytes(content)
        assert str(run_dir / "d.npz") in refused(doctor.main, "replay", run_dir / "d.npz")

    def test_dump_of_something_else(self, run_dir):
        np.savez(run_dir / "d.npz", config=np.asarray(json.dumps(STORED)), x=np.zeros(3))
        assert str(run_dir / "d.npz") in refused(doctor.main, "replay", run_dir / "d.npz")

    def test_options(self, run_dir):
        assert "steps" in refused(doctor.main, "replay", run_dir / "d.npz", "--steps", 0)
        assert "steps" in refused(doctor.main, "replay", run_dir / "d.npz", "--steps", "few")
        assert "diagnose" in refused(doctor.main, "diagnose")
