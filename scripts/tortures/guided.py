"""Give one reader what atheris makes up; run by ``scripts/torture.py guided``.

    python guided.py READER CORPUS [options of libFuzzer]

Whatever a reader raises besides its own clear error ends the process, and atheris reports the input.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import zipfile
from pathlib import Path

import atheris

WATCHED = ["yaml", "sb3_tbc.reading", "sb3_tbc.outside", "sb3_tbc.settings", "sb3_tbc.zoo.config"]
WATCHED += ["sb3_tbc.tbc_hrl.plain", "sb3_tbc.tbc_hrl.archive", "sb3_tbc.ndbc.wiring", "sb3_tbc.tune.search_space"]

with atheris.instrument_imports(include=WATCHED):
    from sb3_tbc import reading
    from sb3_tbc.errors import ConfigError
    from sb3_tbc.ndbc.wiring import NDBCWiring
    from sb3_tbc.tbc_hrl.archive import read_data
    from sb3_tbc.tbc_hrl.plain import NotPlainError, decode
    from sb3_tbc.tune.search_space import read_sections
    from sb3_tbc.zoo.callbacks import read_evaluations
    from sb3_tbc.zoo.config import load_config, parse_overrides

FOLDER = Path(sys.argv[2])


def agent(content: bytes) -> None:
    """A whole archive whose table is made up, or an archive that is."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("data", content)
    read_data(made.getvalue() if len(content) % 2 else content, "it")


def arrays(content: bytes) -> None:
    """A file of arrays."""
    with contextlib.suppress(ValueError):
        reading.read_arrays(io.BytesIO(content))


def yaml(content: bytes) -> None:
    """A text of YAML."""
    reading.parse_yaml(content.decode(errors="surrogateescape"), "it")


def hyperparams(content: bytes) -> None:
    """A setting of the command line, merged into a configuration."""
    load_config("tbc-hrl", "Pendulum", None, parse_overrides([content.decode(errors="surrogateescape")]))


def search(content: bytes) -> None:
    """A file of ranges."""
    path = FOLDER.with_suffix(".yml")
    path.write_bytes(content)
    read_sections(path)


def wiring(content: bytes) -> None:
    """A wiring's plain data."""
    data = json.loads(content)
    if isinstance(data, dict):
        with contextlib.suppress(ValueError):
            NDBCWiring.from_dict(data)


def plain(content: bytes) -> None:
    """An object of an agent's ``plain.json``."""
    with contextlib.suppress(NotPlainError, RecursionError):
        decode(json.loads(content))


def evaluations(content: bytes) -> None:
    """A learning curve."""
    path = FOLDER.with_suffix(".csv")
    path.write_bytes(content)
    read_evaluations(path)


READERS = {f.__name__: f for f in (agent, arrays, yaml, hyperparams, search, wiring, plain, evaluations)}
COLUMNS = b"timesteps,success_rate,episodes,mean_length,subgoal_success,mean_window,wall_time"
SEEDS = {
    "agent": [b'{"policy_class": {":type:": "x", "__module__": "y"}, "num_timesteps": 3}'],
    "yaml": [b"a: &a {b: 1}\nc: {<<: *a, d: [2, .nan]}"],
    "hyperparams": [b"low.gamma:0.9", b"high.policy_kwargs:{net_arch: [64, 64]}", b"low.learning_rate:lin_1e-3"],
    "search": [b"Pendulum:\n  low.gamma: {kind: float, low: 0.9, high: 0.99}\n"],
    "wiring": [json.dumps(NDBCWiring(3, 3, 2, 1, 2, 2, 1, 1, seed=0).to_dict()).encode()],
    "plain": [b'{"plain": "array", "dtype": "<f8", "shape": [2], "values": [1, 2]}', b'{"plain": "tuple"}'],
    "evaluations": [COLUMNS + b"\n1,0,1,1,1,1,1\n"],
}


def main() -> None:
    """Fuzz; atheris ends the process."""
    name, corpus, *options = sys.argv[1:]
    for index, seed in enumerate(SEEDS.get(name, [b"PK"])):
        Path(corpus, f"seed-{index}").write_bytes(seed)

    def once(content: bytes) -> None:
        with contextlib.suppress(ConfigError, json.JSONDecodeError, UnicodeDecodeError, RecursionError):
            READERS[name](content)

    atheris.Setup([sys.argv[0], *options, corpus], once)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
