"""Makes environments of Gymnasium-Robotics available by their plain ids, also with versions of MuJoCo newer than it."""

from __future__ import annotations

import contextlib
import importlib
import io
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np

ROBOTICS = "gymnasium_robotics"


def import_quietly(module: str) -> None:
    """Import a module that registers environments, without the notices that some print; mends Gymnasium-Robotics.

    :param module: its dotted name
    :raises ImportError: if it cannot be imported
    """
    with contextlib.redirect_stderr(io.StringIO()):
        importlib.import_module(module)
    if module.split(".")[0] == ROBOTICS:
        mend_joint_types()


def home_of(env_id: str) -> str | None:
    """Import and name the module that registers an id: ``gymnasium_robotics``, or ``""`` if the id is known already.

    :param env_id: without a module, e.g. ``FetchReach-v4``
    :return: ``None`` if the id is unknown, or Gymnasium-Robotics is needed and not installed
    """
    if env_id not in gym.registry:
        try:
            import_quietly(ROBOTICS)
        except ImportError:
            return None
    spec = gym.registry.get(env_id)
    if spec is None:
        return None
    return ROBOTICS if str(spec.entry_point).startswith(ROBOTICS) else ""


def mend_joint_types() -> bool:
    """Let Gymnasium-Robotics (1.4.2) recognise MuJoCo's joint types again; doing it once is enough.

    Its helpers assert that a joint they set is a hinge or a slide, ``model.jnt_type[i] in (mjJNT_HINGE, mjJNT_SLIDE)``.
    Since MuJoCo 4 an enum member compared with a NumPy integer (this way round, as ``in`` does it) is unequal to it, so
    that no Fetch environment can be built. The helper module is given plain integers of the same names here; nothing
    else is touched, and other versions of MuJoCo are left alone.

    :return: whether there was something to mend
    """
    import mujoco

    free = mujoco.mjtJoint.mjJNT_FREE
    if np.int32(int(free)) in (free,):
        return False
    helpers: Any = importlib.import_module(f"{ROBOTICS}.utils.mujoco_utils")
    if not isinstance(helpers.mujoco, _PlainJoints):
        helpers.mujoco = _PlainJoints(mujoco)
    return True


class _PlainJoints:
    """The module MuJoCo with its joint types as plain integers; everything else is passed through."""

    def __init__(self, module: ModuleType) -> None:
        self._module = module
        self.mjtJoint = SimpleNamespace(**{k: int(v) for k, v in module.mjtJoint.__members__.items()})

    def __getattr__(self, name: str) -> object:
        return getattr(self._module, name)
