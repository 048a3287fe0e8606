"""All settings with defaults, allowed values and help texts: as text for a terminal, as Markdown for the docs.

``python -m sb3_tbc.zoo.settings_page`` prints the page of the documentation.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping
from itertools import groupby

from sb3_tbc.errors import ConfigError, nearest
from sb3_tbc.settings import Entry, Settings, entries
from sb3_tbc.zoo.schema import CONFIG_CLASSES, RunKeys

TITLES = {
    "": "Agent",
    "high": "High level: `high`",
    "high.policy_kwargs": "High level, networks: `high.policy_kwargs`",
    "high.policy_kwargs.net_arch": "High level, layers of actor and critics: `high.policy_kwargs.net_arch`",
    "low": "Low level: `low`",
    "low.policy_kwargs": "Low level, networks: `low.policy_kwargs`",
    "low.policy_kwargs.net_arch": "Low level, layers of actor and critics: `low.policy_kwargs.net_arch`",
    "low.policy_kwargs.ndbc": "Circuit: `low.policy_kwargs.ndbc`",
    "low.policy_kwargs.ndbc.adaptive_step": "Step-size rule: `low.policy_kwargs.ndbc.adaptive_step`",
    "policy_kwargs": "Networks: `policy_kwargs`",
    "policy_kwargs.net_arch": "Layers of actor and critics: `policy_kwargs.net_arch`",
    "subgoals": "Subgoals: `subgoals`",
}
"""Headings of sections; another section is headed by its name."""

NAMES = {"tbc-hrl": "TBC-HRL", "hits": "HiTS", "hac": "HAC", "sac": "SAC"}

INTRODUCTION = """\
# Settings

Every setting has one name, the same in Python, in YAML files and on the command line:

```python
TBCHRL("MultiInputPolicy", env, max_options=10, low={"learning_rate": 1e-3, "policy_kwargs": {"ndbc": {"inter": 16}}})
```

```yaml
max_options: 10
low: {learning_rate: 1.0e-3, policy_kwargs: {ndbc: {inter: 16}}}
```

```bash
python -m sb3_tbc.train --hyperparams max_options:10 low.learning_rate:1e-3 low.policy_kwargs.ndbc.inter:16
```

In a section only what differs from the default has to be given. The default stands in brackets; `null` in YAML is
`None` in Python. A value that is not allowed is refused, and the message names the allowed ones.
`python -m sb3_tbc.train --help-settings` prints all this in the terminal (with `--algo hits` and so on for another
algorithm). What the shipped configurations set for each task is in the folder `zoo_configs`.
"""


def chosen(algo: str) -> type[Settings]:
    """The settings class of an algorithm.

    :raises ConfigError: naming the nearest known algorithm
    """
    if algo not in CONFIG_CLASSES:
        raise ConfigError(f"unknown algorithm {algo!r}; {nearest(algo, CONFIG_CLASSES)}")
    return CONFIG_CLASSES[algo]


def settings_text(algo: str = "tbc-hrl", width: int = 100) -> str:
    """All settings of an algorithm for a terminal: name and default, then what it does and which values are allowed."""
    lines = [f"Settings of {NAMES[algo]}, for --hyperparams NAME:VALUE and configuration files", ""]
    for entry in [*entries(RunKeys), *entries(chosen(algo))]:
        lines.append(entry.name if entry.default is None else f"{entry.name}: {entry.default}")
        told = f"{entry.text} Allowed: {entry.allowed}." if entry.default is not None else entry.text
        lines += textwrap.wrap(told.replace("``", ""), width, initial_indent="    ", subsequent_indent="    ")
    return "\n".join(lines)


def settings_markdown(classes: Mapping[str, type[Settings]] = CONFIG_CLASSES) -> str:
    """The settings page of the documentation.

    :param classes: algorithm -> settings class; the first one is listed in full, of the others only different
        defaults, or everything if they have settings that the first has not
    """
    first, *others = classes
    told = entries(classes[first])
    parts = [INTRODUCTION, _sections(told, f"## {NAMES.get(first, first)}")]
    for algo in others:
        parts.append(_other(NAMES.get(algo, algo), entries(classes[algo]), NAMES.get(first, first), told))
    parts.append(_sections(entries(RunKeys), "## Configuration files also take"))
    return "\n".join(parts)


def _other(name: str, own: list[Entry], first: str, told: list[Entry]) -> str:
    known = {entry.name: entry for entry in told}
    if not {entry.name for entry in own} <= set(known):
        return _sections(own, f"## {name}")
    rows = [f"| `{e.name}` | `{e.default}` |" for e in own if e.default != known[e.name].default]
    head = f"## {name}\n\nThe settings of {first} with other defaults:\n\n| Setting | Default |\n|---|---|\n"
    return head + "\n".join(rows) + "\n"


def _sections(told: list[Entry], title: str) -> str:
    """Settings under a heading for each section."""
    lines = [title, ""]
    for section, group in groupby(told, key=lambda entry: entry.section):
        rows = [entry for entry in group if entry.default is not None]
        if not rows:
            continue
        lines += [f"### {TITLES.get(section, f'`{section}`')}", ""] if section or len(told) > len(rows) else []
        for entry in rows:
            name = entry.name.rpartition(".")[2]
            lines.append(f"- **`{name}`** (`{entry.default}`): {_in_markdown(entry.text)} *Allowed: {entry.allowed}.*")
        lines.append("")
    return "\n".join(lines)


def _in_markdown(text: str) -> str:
    """Docstrings mark code with two backticks, Markdown with one."""
    return text.replace("``", "`")


if __name__ == "__main__":
    sys.stdout.write(settings_markdown())
