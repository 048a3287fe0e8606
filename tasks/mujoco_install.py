"""Says in one line what is wrong with an installation of MuJoCo whose packages do not belong together.

MuJoCo 3 was one package, version 4 is several: after an upgrade of one of them alone, or the removal of the old one,
``import mujoco`` fails in ways that do not name the cure, or gives a module with nothing in it.
"""

from __future__ import annotations

from importlib import metadata
from types import ModuleType

PACKAGES = ("mujoco", "mujoco-core", "mujoco-studio")


def half_upgraded(error: Exception | None = None) -> ImportError:
    """The error to raise, naming what is installed and the cure.

    :param error: what importing MuJoCo raised, if it did
    """
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    why = "" if error is None else f" ({str(error).splitlines()[0]})"
    return ImportError(
        f"MuJoCo cannot be used{why}: installed are {', '.join(found) or 'none of its packages'}, which must all be "
        "there and of one version. Cure: pip install --upgrade --force-reinstall mujoco"
    )


def check_mujoco(module: ModuleType) -> None:
    """See that the module ``mujoco`` holds what it should.

    :raises ImportError: if it is what a half done upgrade leaves
    """
    if not hasattr(module, "MjModel"):
        raise half_upgraded()
