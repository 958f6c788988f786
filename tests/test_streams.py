"""Commands whose output is closed or cannot be written."""

import concurrent.futures
import contextlib
import io
import os
import subprocess
import sys
import time

import family
import pytest

from kslc_jax import cli, streams
from kslc_jax.evaluation import tables


@pytest.fixture
def closed(monkeypatch):
    """Standard output and error whose reader has gone, as in a process of its own."""
    reader, writer = os.pipe()
    os.close(reader)
    for name in ("stdout", "stderr"):
        stream = io.TextIOWrapper(io.FileIO(writer, "w", closefd=False), write_through=True)
        with pytest.raises(BrokenPipeError):
            stream.write("x")
        monkeypatch.setattr(sys, name, stream)
        monkeypatch.setattr(sys, f"__{name}__", stream)
    yield
    os.close(writer)


def test_a_command_goes_on_without_its_reader(closed):
    done = []

    def work():
        for i in range(1000):
            print("x" * 100, flush=i % 2 == 0)
            print("y" * 100, file=sys.stderr)
        done.append(True)
        return 3

    before = sys.stdout
    assert cli.run(work) == 3 and done
    assert sys.stdout is before


def test_a_full_pipe_that_does_not_block_is_waited_for(monkeypatch):
    """Programs such as ssh and node make the pipes and terminals of their children so."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    stream = io.TextIOWrapper(io.FileIO(writer, "w"))
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "__stdout__", stream)
    lines, read = [f"{i:0100}\n" for i in range(5000)], []

    def slow():
        time.sleep(0.1)
        with open(reader) as file:
            read.extend(file)

    with concurrent.futures.ThreadPoolExecutor(1) as other, stream:
        other.submit(slow)
        assert cli.run(lambda: print("".join(lines), end="")) == 0
    assert read == lines


@pytest.fixture
def missing(monkeypatch):
    """Python's streams in a process that was started with closed descriptors: CMD >&- 2>&-"""
    for name in ("stdout", "stderr", "__stdout__", "__stderr__"):
        monkeypatch.setattr(sys, name, None)


def test_all_commands_are_tried():
    assert {"train", "evaluate", "sim2sim", "judge", "play", "export", "plots"} < set(
        family.COMMANDS
    )
    assert {"compare", "learning", "reproduce", "doctor"} < set(family.COMMANDS)


@pytest.mark.parametrize("how", ["closed", "missing"])
@pytest.mark.parametrize("name", family.COMMANDS)
def test_help_without_a_reader(name, how, request):
    request.getfixturevalue(how)
    with pytest.raises(SystemExit) as end:
        family.main(name)(["--help"])
    assert end.value.code == 0


@pytest.mark.parametrize("how", ["closed", "missing"])
@pytest.mark.parametrize("name", family.COMMANDS)
def test_an_error_without_a_reader(name, how, request):
    request.getfixturevalue(how)
    with contextlib.suppress(SystemExit):  # tyro's, for an option that there is not
        assert family.main(name)(["--seed", "x", "--out", "", "--preset", "x"]) == 2


def test_a_table_without_a_stream(missing):
    assert cli.run(lambda: tables.console().print("table")) == 0
    assert sys.stdout is not None  # libraries write to it


def test_help_into_head():
    line = f"{sys.executable} -m kslc_jax.train --help | head -n 1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0" and done.stderr == ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has it")
@pytest.mark.parametrize(("needs_output", "code"), [(True, 2), (False, 0)])
def test_output_onto_a_full_disk(needs_output, code, monkeypatch, capsys):
    """A table that cannot be written is a failure, lines about a training are none."""
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        monkeypatch.setattr(sys, "__stdout__", full)
        assert cli.run(lambda: print("table"), needs_output=needs_output) == code
    said = capsys.readouterr().err
    assert said == "error: cannot write the output: No space left on device\n" * needs_output


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has it")
def test_both_outputs_onto_a_full_disk():
    code = "import sys; from kslc_jax import cli; sys.exit(cli.run(lambda: print('table')))"
    with open("/dev/full", "wb") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=full)
    assert done.returncode == 2


def test_characters_that_the_terminal_lacks_are_escaped(monkeypatch):
    reader, writer = os.pipe()
    with io.TextIOWrapper(io.FileIO(writer, "w"), encoding="ascii") as narrow:
        monkeypatch.setattr(sys, "stdout", narrow)
        monkeypatch.setattr(sys, "__stdout__", narrow)
        assert cli.run(lambda: print("wrote runs/l\xf6we \u2502")) == 0
    with io.FileIO(reader) as file:
        assert file.readall() == rb"wrote runs/l\xf6we \u2502" + b"\n"


def test_streams_of_a_notebook_stay():
    mine = io.StringIO()
    before, sys.stdout = sys.stdout, mine
    try:
        with streams.lasting() as output:
            assert sys.stdout is mine
            print("x")
    finally:
        sys.stdout = before
    assert mine.getvalue() == "x\n" and output.failure is None


def test_missing_streams_are_opened():
    """Else the first file that is opened would be what libraries write errors to."""
    code = "import os; from kslc_jax import streams; streams.open_missing()\n"
    code += "file = open(os.devnull); os.write(2, b'x'); raise SystemExit(file.fileno())"
    done = subprocess.run(["bash", "-c", f'{sys.executable} -c "{code}" 0<&- 1>&- 2>&-'])
    assert done.returncode > 2
