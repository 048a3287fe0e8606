"""The live page in a real browser: the circuit steps as predict does, the slider and lesions show what Python found."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_tbc import TBCHRL
from sb3_tbc.export.policy import extract
from sb3_tbc.interpret import command as interpret
from sb3_tbc.interpret.episodes import HeldOutEpisodes, Trace
from sb3_tbc.interpret.page import SCRIPTS, _asset, plain_policy
from sb3_tbc.interpret.units import CircuitUnits, clamp
from sb3_tbc.pretrained import load_pretrained
from sb3_tbc.zoo.environments import make_env, make_envs
from tests.interpret.browser import new_browser
from tests.interpret.test_command import CIRCUIT, SHORT, saved

STEPS = 1000


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with new_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "pendulum.html"
    assert interpret.main(["pretrained:Pendulum", *SHORT, "--n-episodes", "3", "--html", str(path)]) == 0
    return path


def opened(browser: Any, path: Path, **view: Any) -> Any:
    """A page that is loaded; an error in its script fails the test that asks for ``page.problems``."""
    page = browser.new_page(**view)
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on("request", lambda request: request.url.startswith("http") and page.problems.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_function("window.app && document.getElementById('step').textContent")
    return page


def half_a_step_too_long() -> TBCHRL:
    """Time budgets are 12.5 steps, which are rounded to the even number."""
    model = untrained(whole_budgets=True, dt_max=12.5, high={"policy_kwargs": {"mean_bound": None}})
    with th.no_grad():
        model.high.policy.average_actor.mu.bias[-1] += 100.0
    model.high.acting.refresh()
    return model


def untrained(**settings: Any) -> TBCHRL:
    th.manual_seed(1)
    env = make_envs("sb3_tbc/Pendulum-v0", 1, 0, {})
    return TBCHRL("MultiInputPolicy", env, compile=False, **settings)


AGENTS = {
    "Pendulum": lambda: load_pretrained("Pendulum"),
    "Drawbridge": lambda: load_pretrained("Drawbridge"),
    "UR5Reacher": lambda: load_pretrained("UR5Reacher"),
    "memory": lambda: untrained(memory="window", low={"policy_kwargs": {"ndbc": CIRCUIT}}),
    "reached": lambda: untrained(memory="episode", window_end="reached", low={"policy_kwargs": {"ndbc": CIRCUIT}}),
    "dissipative": lambda: untrained(
        memory="window", low={"policy_kwargs": {"ndbc": {**CIRCUIT, "dynamics": "dissipative"}}}
    ),
    "lean": lambda: untrained(
        memory="window",
        low={"policy_kwargs": {"ndbc": {**CIRCUIT, "synapses": "lean", "sensory_to": ["inter", "command"]}}},
    ),
    "whole": half_a_step_too_long,
    "MLP": lambda: untrained(low={"policy_kwargs": {"net_arch": [8, 8], "ndbc": None}}),
}


@pytest.mark.parametrize("name", AGENTS)
def test_the_page_acts_as_predict(name: str, browser: Any) -> None:
    """A thousand steps of both levels, over several episodes."""
    model = AGENTS[name]()
    task = name if name in ("Drawbridge", "UR5Reacher") else "Pendulum"
    env = make_env(f"sb3_tbc/{task}-v0", **({} if task == "Pendulum" else {"observation": "compact"}))
    seen, starts, actions = [], [], []
    over, state = True, None
    for step in range(STEPS):
        if over:
            observation, _ = env.reset(seed=step)
            state = None
        seen.append({key: part.tolist() for key, part in observation.items()})
        starts.append(over)
        action, state = model.predict(observation, state, deterministic=True)
        actions.append(action)
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    page = browser.new_page()
    for script in ("circuit", "policy"):
        page.add_script_tag(content=_asset(f"{script}.js"))
    ours = page.evaluate(
        """([policy, seen, starts]) => {
            const levels = new TwoLevels(policy), none = noLesion(levels.low.size);
            return seen.map((s, t) => { if (starts[t]) levels.begin(); return levels.act(s, none).action; });
        }""",
        [plain_policy(extract(model)), seen, starts],
    )
    page.close()
    np.testing.assert_allclose(np.array(ours), np.array(actions), atol=1e-5)
    assert np.ptp(np.array(actions), axis=0).max() > 0.01


def test_one_file_below_three_megabytes_and_without_the_network(pendulum: Path, browser: Any) -> None:
    text = pendulum.read_text(encoding="utf-8")
    assert len(text.encode()) < 3_000_000
    assert "@@" not in re.sub(r'src="data:[^"]*"', "", text)
    assert not re.search(r'(src|href)="(?!data:)', text)
    page = opened(browser, pendulum)
    page.wait_for_timeout(200)
    assert page.problems == []
    page.close()


def test_the_simulated_task_is_the_python_task(pendulum: Path, browser: Any) -> None:
    """Every start ends as it did in Python, at the same step and in the same state."""
    page = opened(browser, pendulum)
    env = make_env("sb3_tbc/Pendulum-v0")
    for k in range(3):
        start, run = page.evaluate("k => { app.chooseStart(k); return [app.start, app.run]; }", k)
        assert (run["success"], run["length"]) == (start["success"], start["length"])
        env.reset(seed=50_000_000 + k)
        task: Any = env.unwrapped
        for step in run["steps"]:
            env.step(np.array(step["action"], dtype=np.float32))
        assert run["last"]["angle"] == pytest.approx(float(task.task_state()["qpos"][0]), abs=1e-9)
    page.close()


def test_drawbridge_in_the_page_is_the_python_task(browser: Any) -> None:
    actions = np.random.default_rng(0).uniform(-0.5, 1, 1000)
    env = make_env("sb3_tbc/Drawbridge-v0", observation="compact")
    env.reset(seed=0)
    expected = [env.step(np.array([a], dtype=np.float64))[0]["observation"] for a in actions[:700]]
    page = browser.new_page()
    page.add_script_tag(content="const PENDULUM = {};" + _asset("drawbridge.js"))
    ours = page.evaluate(
        """actions => { const state = DRAWBRIDGE.begin();
            const step = a => { DRAWBRIDGE.advance(state, [a]); return DRAWBRIDGE.observe(state).observation; };
            return actions.map(step); }""",
        actions[:700].tolist(),
    )
    page.close()
    np.testing.assert_allclose(ours, expected, atol=1e-12)


def test_the_slider_shows_the_recorded_potentials(pendulum: Path, browser: Any, traces: list[Trace]) -> None:
    page = opened(browser, pendulum)
    for step in (0, 7, 30):
        page.evaluate("t => { slider.value = t; slider.dispatchEvent(new Event('input')); }", step)
        page.wait_for_function(f"document.getElementById('step').textContent.startsWith('step {step} of')")
        units = page.evaluate("t => Array.from(app.run.steps[t].units)", step)
        np.testing.assert_allclose(units, traces[0].activations[step], atol=1e-5)
        shown = page.locator("#facts dd").first.text_content()
        selected = page.evaluate("app.selected")
        assert float(shown) == pytest.approx(float(traces[0].activations[step][selected]), abs=6e-4)
    page.close()


@pytest.mark.parametrize("neuron", ["inter3", "command2"])
def test_a_clicked_lesion_ends_as_interprets_does(
    neuron: str, pendulum: Path, browser: Any, episodes: HeldOutEpisodes, units: CircuitUnits
) -> None:
    page = opened(browser, pendulum)
    page.locator(f"circle[data-neuron={neuron}]").click()
    page.get_by_role("button", name="Clamp to its mean").click()
    success, mean = page.evaluate("[app.run.success, DATA.mean]")
    steps = page.evaluate("app.run.steps.slice(0, 100).map(s => Array.from(s.units))")
    (expected,) = episodes.record_one(units, clamp(units, [units.names.index(neuron)], np.array(mean)))
    assert success == expected.episode.success
    # Hundreds of steps of a swinging pendulum amplify the last bit, so only the beginning is the same to the digit.
    np.testing.assert_allclose(steps, expected.activations[:100], atol=1e-4)
    said = page.locator("#lesioned").text_content()
    assert said.startswith(f"With {neuron} clamped: {'reached' if success else 'did not reach'}")
    page.get_by_role("button", name="Release", exact=True).click()
    assert page.evaluate("app.run.length === app.whole.length")
    page.close()


def test_keys_dragging_and_narrow_screens(pendulum: Path, browser: Any) -> None:
    page = opened(browser, pendulum, viewport={"width": 390, "height": 844}, color_scheme="dark")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("app.index") == 9
    page.keyboard.press("l")
    assert page.evaluate("app.lesion.held[app.selected]") == 1
    page.keyboard.press("l")
    page.keyboard.press("Space")
    assert page.evaluate("app.playing")
    box = page.locator("#task").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.6, box["y"] + 20)
    page.mouse.down()
    page.mouse.up()
    assert page.evaluate("app.goal[0]") > 0.1
    assert page.problems == []
    page.close()


@pytest.mark.parametrize("kind", ["MLP", "dissipative"])
def test_other_low_levels_have_a_page_too(kind: str, browser: Any, tmp_path: Path) -> None:
    ndbc = None if kind == "MLP" else {**CIRCUIT, "dynamics": "dissipative"}
    path = saved(tmp_path, low={"policy_kwargs": {"net_arch": [6, 6], "ndbc": ndbc}})
    assert interpret.main([str(path), *SHORT, "--html", str(tmp_path / "p.html")]) == 0
    page = opened(browser, tmp_path / "p.html")
    page.evaluate("app.seek(5)")
    page.wait_for_timeout(150)
    assert page.problems == []
    page.close()


@pytest.mark.slow
def test_a_task_of_a_physics_engine_is_recorded(browser: Any, tmp_path: Path) -> None:
    """The page computes the potentials from recorded inputs, whole and lesioned."""
    pytest.importorskip("PIL")
    path = tmp_path / "ur5.html"
    try:
        assert interpret.main(["pretrained:UR5Reacher", *SHORT, "--html", str(path)]) == 0
    except Exception as error:
        if "OpenGL" in str(error) or "GLContext" in type(error).__name__:
            pytest.skip(f"needs OpenGL to film the arm: {error}")
        raise
    assert path.stat().st_size < 3_000_000
    page = opened(browser, path)
    whole, lesioned = page.evaluate(
        "() => { const a = app.run; app.clamp(DATA.most_active, 'mean'); return [a, app.run].map(r => "
        "[r.length, r.success, r.film.frames.length, Array.from(r.steps[3].units)]); }"
    )
    assert whole[2] > 10
    assert lesioned[3] != whole[3]
    assert page.problems == []
    page.close()


def test_every_script_is_in_the_page() -> None:
    assets = {p.stem for p in (Path(interpret.__file__).parent / "assets").glob("*.js")}
    assert assets == set(SCRIPTS)
