"""Agents on the Hugging Face Hub (extra ``hub``), in the layout of SB3's own hub package, ``huggingface_sb3``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_tbc.errors import ConfigError
from sb3_tbc.extras import require
from sb3_tbc.outside import one_line

if TYPE_CHECKING:
    from sb3_tbc.tbc_hrl.evaluation import Agent

MODEL, CARD = "model.zip", "README.md"
HEAD = "---\nlibrary_name: stable-baselines3\ntags:\n- reinforcement-learning\n- stable-baselines3\n- sb3_tbc\n---\n"
"""Begins a model card: by this the Hub lists the agent among those of SB3."""


def push_to_hub(
    agent: BaseAlgorithm | Path | str,
    repo_id: str,
    filename: str = MODEL,
    card: str | None = None,
    commit_message: str = "Add agent",
    token: str | None = None,
    private: bool = False,
) -> str:
    """Upload an agent and its model card to a repository of the Hugging Face Hub, which is made if need be.

    :param agent: an agent, or a ``.zip`` that one was saved to
    :param repo_id: ``"owner/name"``
    :param filename: name of the ``.zip`` in the repository; slashes lead into folders, which are made
    :param card: model card in Markdown; by default the ``.md`` file beside a ``.zip``, as the package's own agents
        have one, else one line
    :param commit_message: what the repository's history says
    :param token: of your account; by default that of ``huggingface-cli login``
    :param private: whether a new repository is yours alone to see
    :return: address of the commit
    :raises ConfigError: if the file does not exist, ``filename`` leads out of the repository or is none of a ``.zip``,
        or the Hub refuses or cannot be reached
    """
    api = require("huggingface_hub", extra="hub", what="pushing to the Hub").HfApi()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own_card = _gather(agent, _inside(folder, filename))
        text = own_card if card is None else card
        (folder / CARD).write_text(text if text.startswith("---") else HEAD + text, encoding="utf-8")
        try:
            api.create_repo(repo_id, token=token, private=private, exist_ok=True)
            done = api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=commit_message, token=token)
        except Exception as error:  # requests, huggingface_hub and the Hub itself each have their own kinds
            raise ConfigError(f"cannot push to {repo_id} on the Hub: {one_line(error, 300)}") from error
    return str(done)


def _inside(folder: Path, filename: str) -> Path:
    """The place of a file in a folder; the folders between are made."""
    path = folder / filename
    if path.suffix != ".zip":  # saving adds the ending, and the model card has a name of its own
        raise ConfigError(f"filename must end in .zip, as pendulum/model.zip; got {filename!r}")
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(f"filename must lie in the repository, as pendulum/model.zip; got {filename!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _gather(agent: BaseAlgorithm | Path | str, target: Path) -> str:
    """Put an agent's ``.zip`` where it is to be; the text of its model card."""
    if isinstance(agent, BaseAlgorithm):
        agent.save(target)
        return f"# {type(agent).__name__}\n\nAn agent of sb3_tbc.\n"
    source = Path(agent)
    if not source.is_file():
        raise ConfigError(f"no such file: {source} (an agent is saved as .zip by train or model.save)")
    target.write_bytes(source.read_bytes())
    card = source.with_suffix(".md")
    return card.read_text(encoding="utf-8") if card.is_file() else f"# {source.stem}\n\nAn agent of sb3_tbc.\n"


def download_from_hub(repo_id: str, filename: str = MODEL) -> Path:
    """A file of a repository of the Hub, downloaded into the Hub's own cache; nothing of it is used.

    :param repo_id: ``"owner/name"``
    :param filename: name of the file in the repository
    :raises ConfigError: if there is none, or the Hub cannot be reached
    """
    hub = require("huggingface_hub", extra="hub", what="loading from the Hub")
    try:
        return Path(hub.hf_hub_download(repo_id, filename))
    except Exception as error:  # as above
        raise ConfigError(f"cannot download {filename} of {repo_id} from the Hub: {one_line(error, 300)}") from error


def load_from_hub(
    repo_id: str, filename: str = MODEL, env: Any = None, device: str = "cpu", trust: bool = False
) -> Agent:
    """Load an agent from the Hugging Face Hub. A stranger's file runs no code, unless you say that you trust it.

    Agents of :class:`~sb3_tbc.recurrent.NDBCSAC` are loaded by ``NDBCSAC.load(download_from_hub(...))``.

    :param repo_id: ``"owner/name"``
    :param filename: name of the ``.zip`` in the repository
    :param env: environments to act in, if the agent is to go on learning
    :param device: torch device
    :param trust: whether code from the file may run, see :meth:`.PlainAlgorithm.load`
    :raises UntrustedError: if it cannot be loaded without that
    :raises ConfigError: if it cannot be downloaded or loaded
    """
    from sb3_tbc.zoo.algorithms import load_model

    return load_model(download_from_hub(repo_id, filename), env, device, trust)
