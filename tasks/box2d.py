"""What the Box2D tasks share: the import with a useful message, and fixtures made once."""

from __future__ import annotations

import functools
from types import ModuleType
from typing import Any


def load_box2d() -> ModuleType:
    """Import Box2D.

    :raises ImportError: naming the extra that installs it
    """
    try:
        import Box2D
    except ImportError as error:
        raise ImportError("Platforms and Tennis2D need Box2D. Install it with: pip install 'sb3_tbc[box2d]'") from error
    module: ModuleType = Box2D
    return module


@functools.cache
def box_fixture(half_width: float, half_height: float, **attributes: float) -> Any:
    """Definition of a rectangular fixture; cached, because the bindings lose the memory of each definition.

    :param half_width: metres
    :param half_height: metres
    :param attributes: ``density``, ``restitution``, ``groupIndex``, ...
    """
    b2 = load_box2d()
    return b2.b2FixtureDef(shape=b2.b2PolygonShape(box=(half_width, half_height)), **attributes)


@functools.cache
def circle_fixture(radius: float, **attributes: float) -> Any:
    """Definition of a circular fixture; see :func:`box_fixture`."""
    b2 = load_box2d()
    return b2.b2FixtureDef(shape=b2.b2CircleShape(radius=radius), **attributes)
