"""Settings as frozen dataclasses: each field says what it may hold, and checks, plain data and texts follow from that.

A field is declared once, with its type, its default and a docstring below it::

    gamma: Annotated[float, Range(0, 1)] = 0.99
    \"\"\"Discount per decision.\"\"\"

Types may be ``bool, int, float, str``, a ``Literal``, a ``tuple``, a ``dict``, any class, another settings dataclass,
and unions of these; numbers have to be finite. This folder knows no particular settings.
"""

from sb3_tbc.settings.domains import Domain, Increasing, NotEmpty, Prefixed, Range
from sb3_tbc.settings.fields import SettingError, Settings, flat, merge, plain, read, read_partial
from sb3_tbc.settings.kinds import default_of, hints, section_of, split
from sb3_tbc.settings.listing import Entry, entries
from sb3_tbc.settings.texts import describe

__all__ = [
    "Domain",
    "Entry",
    "Increasing",
    "NotEmpty",
    "Prefixed",
    "Range",
    "SettingError",
    "Settings",
    "default_of",
    "describe",
    "entries",
    "flat",
    "hints",
    "merge",
    "plain",
    "read",
    "read_partial",
    "section_of",
    "split",
]
