"""Who may import whom, found by walking the source; and what importing the package must not drag in."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sb3_tbc"

# From bottom to top: a folder (or a module beside the folders) imports from itself and from lower layers alone.
LAYERS = (
    ("aliases", "former_names", "interruption", "errors", "stats", "arrays"),
    ("files", "outside", "stopping", "settings"),
    ("reading",),
    ("commands", "extras", "smdp"),
    ("replay", "ndbc", "tasks", "zoo_configs"),
    ("level",),
    ("tbc_hrl",),
    ("zoo", "recurrent"),
    ("pretrained", "campaign", "hub"),
    ("train", "evaluate", "report"),
    ("tune", "export", "reproduce"),
    ("benchmark", "interpret"),
    ("__main__",),
)
LAYER = {name: index for index, names in enumerate(LAYERS) for name in names}

TASK_PACKAGES = {"gymnasium", "gymnasium_robotics", "numpy", "mujoco", "Box2D", "pybullet", "tkinter", "pygame"}
GIVEN_TO_TASKS = tuple(
    f"sb3_tbc.{name}" for name in ("aliases", "arrays", "smdp.spaces", "smdp.goal_spaces", "smdp.goal_test", "errors")
)
NO_TORCH = (
    "sb3_tbc.arrays",
    "sb3_tbc.smdp.goal_spaces",
    "sb3_tbc.tasks",
    "sb3_tbc.smdp.spaces",
    "sb3_tbc.errors",
    "sb3_tbc.smdp.options",
    "sb3_tbc.ndbc.wiring",
    "sb3_tbc.stats",
)
HEAVY = ("optuna", "matplotlib", "pybullet", "Box2D", "imageio", "rl_zoo3", "onnx", "mujoco")


def modules() -> dict[str, Path]:
    """All modules of the package by name; ``tasks/`` is installed as ``sb3_tbc.tasks``."""
    found = {}
    for folder, prefix in ((PACKAGE, "sb3_tbc"), (ROOT / "tasks", "sb3_tbc.tasks")):
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join([prefix, *parts])] = path
    return found


MODULES = modules()


def imports(name: str, everywhere: bool) -> list[str]:
    """Modules that a module imports; with ``everywhere`` also those inside functions."""
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    is_package = MODULES[name].name == "__init__.py"
    nodes = ast.walk(tree) if everywhere else _at_import(tree)
    result = []
    for node in nodes:
        if isinstance(node, ast.Import):
            result += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = name.split(".") if is_package else name.split(".")[:-1]
            base = base[: len(base) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            inner = [f"{module}.{alias.name}" for alias in node.names]
            result += [i if i in MODULES else module for i in inner]
    return result


def _at_import(tree: ast.AST) -> list[ast.AST]:
    """Nodes that run when the module is imported: no function bodies, nothing under ``if TYPE_CHECKING``."""
    found, waiting = [], [tree]
    while waiting:
        node = waiting.pop()
        found.append(node)
        typing_only = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and not typing_only:
            waiting += ast.iter_child_nodes(node)
    return found


def place(name: str) -> str:
    """Folder of a module, or the module itself where it lies beside the folders."""
    return name.split(".")[1]


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_point_downwards(name: str) -> None:
    if name == "sb3_tbc":
        return  # the front door shows what lies behind it
    for imported in imports(name, everywhere=True):
        if imported.startswith("sb3_tbc.") and place(imported) != place(name):
            assert LAYER[place(imported)] < LAYER[place(name)], f"{name} must not import {imported}"


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    """Imports inside functions and for type checking count: whoever reads one module of a circle has to read all."""
    graph = {name: {i for i in imports(name, everywhere=True) if i in MODULES and i != name} for name in MODULES}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as circle:
        pytest.fail(f"a circle of imports: {' <- '.join(circle.args[1])}")


def test_every_folder_has_a_layer() -> None:
    assert {place(name) for name in MODULES if name != "sb3_tbc"} <= set(LAYER)


@pytest.mark.parametrize("name", sorted(n for n in MODULES if n.startswith("sb3_tbc.tasks")))
def test_tasks_need_gymnasium_numpy_and_spaces_only(name: str) -> None:
    for imported in imports(name, everywhere=True):
        top = imported.split(".")[0]
        if top == "sb3_tbc":
            assert imported.startswith(("sb3_tbc.tasks", *GIVEN_TO_TASKS)), f"{name}: {imported}"
        else:
            assert top in TASK_PACKAGES | set(sys.stdlib_module_names), f"{name} must not import {imported}"


@pytest.mark.parametrize("name", sorted(n for n in MODULES if n.startswith(NO_TORCH)))
def test_no_torch_where_arrays_are_enough(name: str) -> None:
    assert not [i for i in imports(name, everywhere=True) if i.split(".")[0] in ("torch", "stable_baselines3")]


def test_nothing_evaluates_text() -> None:
    for name, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec"), f"{name}:{node.lineno}"


def test_importing_the_package_stays_light() -> None:
    code = f"import sys, sb3_tbc, gymnasium; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
