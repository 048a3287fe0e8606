"""Errors that name what went wrong inside a hierarchy; other user mistakes are ``ValueError`` or ``TypeError``."""


class HierarchyError(RuntimeError):
    """The two levels were used out of order, e.g. stepping before a reset."""


class NonFiniteError(FloatingPointError):
    """A value became NaN or infinite; the message names level, layer and step."""


class ConfigError(ValueError):
    """A configuration names what does not exist or has the wrong type; the message names the nearest match."""
