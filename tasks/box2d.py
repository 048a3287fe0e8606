"""What the Box2D tasks share: the import with a useful message, and the ways bodies are made."""

from __future__ import annotations

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


def box_body(world: Any, kind: int, centre: tuple[float, float], size: tuple[float, float], **fixture: Any) -> Any:
    """Add a body with one rectangle.

    :param world: the Box2D world
    :param kind: ``b2_staticBody``, ``b2_kinematicBody`` or ``b2_dynamicBody``
    :param centre: of the rectangle, metres
    :param size: full width and height, metres
    :param fixture: further fixture attributes (density, friction, ...)
    """
    b2 = load_box2d()
    shape = b2.b2PolygonShape(box=(size[0] / 2, size[1] / 2))
    return world.CreateBody(type=kind, position=centre, fixtures=b2.b2FixtureDef(shape=shape, **fixture))
