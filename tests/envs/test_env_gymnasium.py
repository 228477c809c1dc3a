"""What gymnasium itself does with the environments: its vector wrappers, specs, copies, processes."""

import copy
import inspect
import pickle
import sys
import types

import gymnasium
import gymnasium.wrappers.vector as wrappers
import numpy as np
import pytest
import torch
from env_cases import CASES, HAS_MAPS, make, make_vec, param, same
from gymnasium.vector import AutoresetMode
from PIL import Image

from navrep_data import envs
from navrep_data.schema import Event

SMALL = {"time_limit": 2.0, "humans": 1, "obstacles": 1}
IMAGES = {"GrayscaleObservation", "ResizeObservation"}
"""Wrappers of pictures: scans are none."""
SHOW = {"HumanRendering", "RecordVideo"}
"""Wrappers of what is rendered; the latter needs moviepy, which is not among our packages."""
ARRAYS = {"ArrayConversion", "NumpyToTorch"}
"""Wrappers that need array-api-compat, and torch as the other library; those for jax do the same with jax."""
WRAPPERS = sorted({name for name, value in vars(wrappers).items() if inspect.isclass(value)} - IMAGES - SHOW)
FLAT = {"DtypeObservation", "NormalizeObservation", "RescaleObservation", "ReshapeObservation"}
"""Wrappers that gymnasium wants one Box for."""
ARGUMENTS = {
    "ClipReward": lambda env: (-1.0, 1.0),
    "DtypeObservation": lambda env: (np.float64,),
    "FilterObservation": lambda env: (["scan"],),
    "RescaleAction": lambda env: (np.float32(-2.0), np.float32(2.0)),
    "RescaleObservation": lambda env: (np.float32(0.0), np.float32(1.0)),
    "ReshapeObservation": lambda env: ((*env.single_observation_space.shape, 1),),
    "TransformAction": lambda env: (lambda action: action,),
    "TransformObservation": lambda env: (lambda observation: observation,),
    "TransformReward": lambda env: (lambda reward: reward,),
    "VectorizeTransformAction": lambda env: (
        gymnasium.wrappers.TransformAction, {"func": lambda action: action, "action_space": env.single_action_space}
    ),
    "VectorizeTransformObservation": lambda env: (
        gymnasium.wrappers.TransformObservation,
        {"func": lambda observation: observation, "observation_space": env.single_observation_space},
    ),
    "VectorizeTransformReward": lambda env: (gymnasium.wrappers.TransformReward, {"func": lambda reward: reward}),
}  # fmt: skip


def wrap(name, env):
    env = envs.VectorFlatObservation(env) if name in FLAT else env
    arguments = ARGUMENTS.get(name, lambda env: ())(env)
    keywords = arguments[-1] if arguments and isinstance(arguments[-1], dict) else {}
    return getattr(wrappers, name)(env, *arguments[: len(arguments) - bool(keywords)], **keywords)


@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")  # of float32 bounds, in gymnasium
@pytest.mark.parametrize("name", WRAPPERS)
def test_every_vector_wrapper_of_gymnasium_goes_around_ours(name):
    env = wrap(name, make_vec("navrep-train", 3, autoreset_mode="NextStep", **SMALL))
    env.reset(seed=1)
    ended = 0
    for _ in range(15):
        _, _, terminations, truncations, infos = env.step(np.zeros((3, 3), np.float32))
        ended += int((terminations | truncations).sum())
    assert ended == 3
    assert len(infos) > 0
    env.close()


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_wrappers_for_other_arrays(name):
    env = make_vec("navrep-train", 3, autoreset_mode="NextStep", **SMALL)
    more = {"env_xp": np, "target_xp": torch} if name == "ArrayConversion" else {}
    wrapped = getattr(wrappers, name)(env, **more)
    wrapped.reset(seed=1)
    scans, rewards, _, _, infos = wrapped.step(torch.zeros(3, 3))
    assert isinstance(scans["scan"], torch.Tensor)
    assert isinstance(rewards, torch.Tensor)
    assert infos["event"].tolist() == [Event.NONE] * 3


def resize(image, size):
    """Do what OpenCV does: gymnasium wants that one function of it, which is too large a package for that."""
    return np.asarray(Image.fromarray(image).resize(size))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:pkg_resources is deprecated:UserWarning")  # where pygame finds old setuptools
def test_a_window_shows_the_environments(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # a window, but no screen
    monkeypatch.setitem(sys.modules, "cv2", types.SimpleNamespace(resize=resize))
    more = {"autoreset_mode": "NextStep", "render_mode": "rgb_array", **SMALL}
    for wrapped in (
        gymnasium.wrappers.HumanRendering(make("navrep-train", render_mode="rgb_array", **SMALL)),
        wrappers.HumanRendering(make_vec("navrep-train", 2, **more)),
    ):
        wrapped.reset(seed=1)
        before = pygame.surfarray.array3d(wrapped.window)
        for _ in range(3):
            wrapped.step(np.ones(wrapped.action_space.shape, np.float32))
        after = pygame.surfarray.array3d(wrapped.window)
        assert len(np.unique(before.reshape(-1, 3), axis=0)) > 3
        assert (before != after).any()
        wrapped.close()


@pytest.mark.slow
def test_infos_are_numbers_that_arrays_of_other_libraries_can_be_made_of():
    """Strings and objects have no place in torch or jax; final_obs alone is an object array, as gymnasium has it."""
    names = ["navrep-test", "crowdmove-1", "ian"] if HAS_MAPS else ["navrep-test"]
    for name in names:
        env = make_vec(name, 2, autoreset_mode="NextStep", max_episode_steps=2)
        infos = [env.reset(seed=1)[1], *(env.step(np.zeros(env.action_space.shape))[4] for _ in range(3))]
        for info in infos:
            for key, value in info.items():
                assert value.dtype.kind in "biuf", (name, key)
                np.from_dlpack(value)


@pytest.mark.slow
@pytest.mark.parametrize(("env", "physics"), CASES)
def test_the_spec_says_how_long_an_episode_can_be(env, physics):
    """A robot that stands still, alone, is stopped by the time limit in that step and in no other."""
    people = {} if env == "ian" else {"humans": 0}
    single = make(env, physics=physics, time_limit=2.5, **people)
    vector = make_vec(env, 2, physics=physics, time_limit=2.5, **people)
    most = single.spec.max_episode_steps
    assert most == single.unwrapped.config.max_steps == vector.spec.max_episode_steps
    single.reset(seed=3)
    lengths = []
    for k in range(1, 20):
        if single.step(np.zeros(single.action_space.shape))[3]:
            lengths.append(k)
            break
    assert lengths == ([most] if most is not None else [])
    assert (most is None) == (physics == "original" and env.startswith("crowdmove"))
    assert gymnasium.spec("NavRepTrain-v0").max_episode_steps is None


def test_a_spec_makes_the_same_environment_again():
    single = make("navrep-test", physics="original", humans=2)
    again = gymnasium.make(single.spec)
    assert again.unwrapped.config == single.unwrapped.config
    assert same(again.reset(seed=5)[0], single.reset(seed=5)[0])
    vector = make_vec("navrep-test", 3, humans=2, autoreset_mode="NextStep")
    spec = vector.unwrapped.spec
    assert spec.kwargs["num_envs"] == 3
    other = gymnasium.make_vec(spec, num_envs=3)
    assert other.unwrapped.config == vector.config
    assert other.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert same(other.reset(seed=5)[0], vector.reset(seed=5)[0])


def pickled(env):
    return pickle.loads(pickle.dumps(env))  # noqa: S301  our own


@pytest.mark.slow
@pytest.mark.parametrize("how", [copy.deepcopy, pickled])
@pytest.mark.parametrize("env", ["navrep-train", "navrep-test", param("ian")])
def test_copies_go_on_alike(env, how):
    for made in (make_vec(env, 2), envs.FlatObservation(envs.RingsObservation(make(env)))):
        made.reset(seed=3)
        action = np.full(made.action_space.shape, 0.3, np.float32)
        made.step(action)
        other = how(made)
        for a, b in zip(made.step(action), other.step(action), strict=True):
            assert same(a, b)


@pytest.mark.slow
def test_environments_run_in_processes_of_gymnasiums():
    both = [
        gymnasium.make_vec("navrep_data:NavRepTrain-v0", 2, vectorization_mode=mode, pad_humans=True, **SMALL)
        for mode in ("async", "sync")
    ]
    starts = [env.reset(seed=4)[0] for env in both]
    assert same(*starts)
    for _ in range(12):
        steps = [env.step(np.zeros((2, 3), np.float32)) for env in both]
        assert all(same(a, b) for a, b in zip(*steps, strict=True))
    for env in both:
        env.close()
