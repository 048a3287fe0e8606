"""Modules that have moved: their former names still import, and agents saved under those names still load.

A saved agent names the classes it needs by module. A former name gives the same module object as the present name, so
that each class exists once, whichever name it was imported by.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType
from typing import Any

FORMER_NAMES = {
    "sb3_tbc.buffers": "sb3_tbc.replay.buffers",
    "sb3_tbc.callbacks": "sb3_tbc.zoo.callbacks",
    "sb3_tbc.cli": "sb3_tbc.commands",
    "sb3_tbc.evaluation": "sb3_tbc.tbc_hrl.evaluation",
    "sb3_tbc.export_c": "sb3_tbc.export.c99",
    "sb3_tbc.export_check": "sb3_tbc.export.check",
    "sb3_tbc.export_numpy": "sb3_tbc.export.numpy_module",
    "sb3_tbc.export_onnx": "sb3_tbc.export.onnx_graph",
    "sb3_tbc.export_policy": "sb3_tbc.export.policy",
    "sb3_tbc.flat": "sb3_tbc.tbc_hrl.flat_sac",
    "sb3_tbc.hindsight": "sb3_tbc.smdp.hindsight",
    "sb3_tbc.layout": "sb3_tbc.smdp.views",
    "sb3_tbc.low_reward": "sb3_tbc.smdp.rewards",
    "sb3_tbc.options": "sb3_tbc.smdp.options",
    "sb3_tbc.plotting": "sb3_tbc.report.curves",
    "sb3_tbc.ring_buffer": "sb3_tbc.replay.ring",
    "sb3_tbc.spaces": "sb3_tbc.smdp.spaces",
    "sb3_tbc.tasks.benchmark": "sb3_tbc.benchmark.tasks",
    "sb3_tbc.tbc_hrl.acting": "sb3_tbc.level.acting",
    "sb3_tbc.tbc_hrl.compilation": "sb3_tbc.level.compilation",
    "sb3_tbc.tbc_hrl.level": "sb3_tbc.level.level",
    "sb3_tbc.tbc_hrl.policies": "sb3_tbc.level.policies",
    "sb3_tbc.tbc_hrl.replay": "sb3_tbc.replay.both_levels",
    "sb3_tbc.tbc_hrl.settings": "sb3_tbc.tbc_hrl.config",
    "sb3_tbc.tbc_hrl.two_level_policy": "sb3_tbc.tbc_hrl.policy",
    "sb3_tbc.tbc_hrl.update": "sb3_tbc.level.update",
    "sb3_tbc.type_aliases": "sb3_tbc.replay.batch",
    "sb3_tbc.vec_env": "sb3_tbc.smdp",
    "sb3_tbc.vec_env.goal_vec_env": "sb3_tbc.smdp.goal_vec_env",
    "sb3_tbc.vec_env.hierarchical_vec_env": "sb3_tbc.smdp.hierarchical_vec_env",
    "sb3_tbc.vec_env.recorder": "sb3_tbc.smdp.recorder",
    "sb3_tbc.video": "sb3_tbc.zoo.video",
    "sb3_tbc.zoo.pruning": "sb3_tbc.tune.pruning",
    "sb3_tbc.zoo.scores": "sb3_tbc.tune.objectives",
    "sb3_tbc.zoo.search_space": "sb3_tbc.tune.search_space",
    "sb3_tbc.zoo.study": "sb3_tbc.tune.study",
    "sb3_tbc.zoo.study_report": "sb3_tbc.tune.results",
    "sb3_tbc.zoo.trial": "sb3_tbc.tune.trial",
    "sb3_tbc.zoo.worker": "sb3_tbc.tune.worker",
}
"""Former name -> present name."""


class FormerNames(MetaPathFinder, InspectLoader):
    """Finds modules under their former names; a module is imported when it is asked for, not before."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Called by the import system; None for a name that is not a former one."""
        if fullname not in FORMER_NAMES:
            return None
        present = importlib.util.find_spec(FORMER_NAMES[fullname])
        return ModuleSpec(fullname, self, origin=None if present is None else present.origin)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module itself, under its present name."""
        module = importlib.import_module(FORMER_NAMES[spec.name])
        spec.loader_state = module.__spec__, module.__loader__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Run nothing, since the module ran when it was imported; put back what the import system has overwritten."""
        written: Any = module.__spec__
        module.__spec__, module.__loader__ = written.loader_state

    def get_code(self, fullname: str) -> CodeType | None:
        """For ``python -m`` with a former name."""
        spec = importlib.util.find_spec(FORMER_NAMES[fullname])
        loader = None if spec is None else spec.loader
        return loader.get_code(FORMER_NAMES[fullname]) if isinstance(loader, InspectLoader) else None

    def get_source(self, fullname: str) -> str | None:
        """Not asked for: the source lies under the present name."""
        return None


def install() -> None:
    """Let former names be imported from now on."""
    if not any(isinstance(finder, FormerNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, FormerNames())
