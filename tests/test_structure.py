"""The structure of the package: imports have no cycle, the evaluation needs no training, commands
start without JAX, only `robots` names the parts of a robot, and functions are short."""

import ast
import importlib.util
import json
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import kslc_jax

ROOT = Path(kslc_jax.__file__).parent


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


MODULES = {_name(path): path for path in sorted(ROOT.rglob("*.py"))}

WINGS = ("kslc_jax.evaluation", "kslc_jax.viewer", "kslc_jax.checkup")
COMMANDS = tuple(
    f"kslc_jax.{name}" for name in ("evaluate", "sim2sim", "judge", "falls", "play", "export")
)
NO_TRAINING = [n for n in MODULES if n.startswith(WINGS) or n in ("kslc_jax.policy", *COMMANDS)]

OPTIONAL = {"kslc_jax.evaluation.drake": "pydrake", "kslc_jax.viewer.app": "viser"}
OPTIONAL |= {"kslc_jax.viewer.panel": "viser", "kslc_jax.viewer.shapes": "trimesh"}
"""Modules that need an optional package, with its name."""

LIGHT = (
    "config",
    "robots",
    "errors",
    "files",
    "streams",
    "cli",
    "train",
    "evaluate",
    "sim2sim",
    "play",
)
LIGHT += (
    "judge",
    "falls",
    "export",
    "compare",
    "reproduce",
    "doctor",
    "learning",
    "plots",
    "records",
)
LIGHT += ("evaluation.tables", "evaluation.perturbations")
"""Modules that do not import JAX, so that a config check and `--help` are quick."""


def imported(tree: ast.AST, package: str) -> set[str]:
    """Modules of this package that a module imports: anywhere in its text, also only for types."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where they point"
            module = node.module or ""
            names = {f"{module}.{alias.name}" for alias in node.names}
            submodules = names & MODULES.keys()
            # `from package import module` counts as an import of the module, not of the package.
            found |= submodules or {module}
    return {name for name in found if name in MODULES and name != package}


GRAPH = {name: imported(ast.parse(path.read_text()), name) for name, path in MODULES.items()}


def test_imports_have_no_circle():
    assert "kslc_jax.env" in GRAPH["kslc_jax.rollout"]
    TopologicalSorter(GRAPH).prepare()  # CycleError names the circle


def reached(name: str) -> set[str]:
    """All modules of this package that a module imports, directly or through other modules."""
    found, todo = set(), [name]
    while todo:
        new = GRAPH[todo.pop()] - found
        found |= new
        todo += new
    return found


@pytest.mark.parametrize("name", NO_TRAINING)
def test_judging_and_looking_import_no_training(name):
    """This includes imports inside functions."""
    assert not [other for other in reached(name) if other.startswith("kslc_jax.training")]


def loaded_by(*modules: str) -> dict[str, set[str]]:
    """The loaded modules of a fresh process after each of these imports, one after the other."""
    code = "import importlib, json, sys\nfor name in sys.argv[1:]:\n"
    code += "    importlib.import_module(name)\n    print(json.dumps([name, [*sys.modules]]))"
    done = subprocess.run(
        [sys.executable, "-c", code, *modules],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    return {name: set(loaded) for name, loaded in lines}


def test_no_training_is_loaded_with_judging_and_looking():
    there = [n for n in NO_TRAINING if importlib.util.find_spec(OPTIONAL.get(n, "sys"))]
    for name, loaded in loaded_by(*there).items():
        assert not [m for m in loaded if m.startswith("kslc_jax.training")], name


def test_configs_and_commands_load_no_jax():
    for name, loaded in loaded_by(*(f"kslc_jax.{name}" for name in LIGHT)).items():
        assert not {"jax", "mujoco", "orbax"} & loaded, name


def test_only_robots_names_the_parts_of_a_robot():
    """The rest reads them from the model. Roles, such as left_knee, are no names of parts."""
    from kslc_jax import robot

    xbot = robot.load("high")
    model = xbot.mj_model
    parts = {model.joint(i).name for i in range(model.njnt)} | set(xbot.joint_names)
    parts |= {model.body(i).name for i in range(1, model.nbody)}
    parts -= xbot.anatomy.roles.keys()
    assert {"left_leg_pitch_joint", "base_link"} <= parts
    for name, path in MODULES.items():
        tree = ast.parse(path.read_text())
        texts = {x.value for x in ast.walk(tree) if isinstance(x, ast.Constant)}
        assert name.startswith("kslc_jax.robots") or not texts & parts, name


MOST_OF_BODY, MOST_OF_MODULE = 40, 300
"""Lines of code in a function's body, and in a module (CONTRIBUTING.md)."""

LONG = 8
"""A list, table or call with so many parts counts as one line: it is read like a table."""


def lines_of_code(statements: list[ast.stmt]) -> int:
    """Number of lines without docstrings, comments and empty lines; long lists count once."""
    lines, spared = set(), set()
    for node in (x for statement in statements for x in ast.walk(statement)):
        first, last = getattr(node, "lineno", 0), getattr(node, "end_lineno", 0)
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                spared |= set(range(first, last + 1))
            case ast.Dict(keys=parts) | ast.List(elts=parts) | ast.Tuple(elts=parts):
                spared |= set(range(first + 1, last + 1)) if len(parts) >= LONG else set()
            case ast.Call():
                parts = [*node.args, *node.keywords]
                spared |= set(range(first + 1, last + 1)) if len(parts) >= LONG else set()
        if isinstance(node, ast.expr | ast.arg | ast.stmt | ast.keyword):
            lines |= {first, last}
    return len(lines - spared)


def test_lines_of_code():
    text = '''
def f(a):
    """One
    two."""
    # a comment
    b = [1, 2,

         3]
    return dict(
        a=1, b=2, c=3, d=4,
        e=5, f=6, g=7, h=8,
    )
'''
    (function,) = ast.parse(text).body
    assert isinstance(function, ast.FunctionDef)
    assert lines_of_code(function.body) == 3


@pytest.mark.parametrize("name", MODULES)
def test_functions_and_modules_are_short(name):
    tree = ast.parse(MODULES[name].read_text())
    assert lines_of_code(tree.body) <= MOST_OF_MODULE
    functions = [x for x in ast.walk(tree) if isinstance(x, ast.FunctionDef)]
    long = {f.name: n for f in functions if (n := lines_of_code(f.body)) > MOST_OF_BODY}
    assert not long
