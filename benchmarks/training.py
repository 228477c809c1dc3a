"""Frames per second of world-model training and steps per second of controller training.

    python benchmarks/training.py [--only transformer_rings ...] [--write] [--json]

World models: one training step on frames in memory (forward, backward, AdamW), ours against the layers as they are
written (float32, torch's transposed convolutions, everything decoded), in turns (A B A B ...). Encoders in 8 bits, as
controllers are trained through them, likewise against themselves in bfloat16; convolutions of end-to-end networks
there and back. Controllers: whole PPO iterations
(rollout in 256 worlds, encoding, update), as the default recipe has them. Wall time, with as many threads as torch
takes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import Any

from harness import in_turns, machine, ratio, spread
from report import describe, number, table, write_section

WORLD_MODELS = ("transformer_rings", "joint_rings", "transformer_1d", "joint_1d")
CONTROLLERS = ("rings_z", "1d_z")
ENCODERS = ("encoder_rings", "encoder_1d")
END_TO_END = ("e2e_rings", "e2e_1d")
MUST = {"transformer_rings": 900, "rings_z": 10_000, "1d_z": 18_000}
AIMS = {"transformer_rings": 1_300, "rings_z": 14_000, "1d_z": 25_000}
WINDOWS = 32


def made_up_batch(lidar: str) -> dict[str, Any]:
    """Return a batch of 32 windows of 32 rows, a sixth of them padding as in soadrl data."""
    import torch

    generator = torch.Generator().manual_seed(0)
    shape = (64, 64) if lidar == "rings" else (1080,)
    rows = torch.randint(20, 34, (WINDOWS,), generator=generator)
    mask = torch.arange(33) < rows[:, None]
    frames = torch.randint(0, 3, (WINDOWS, 33, *shape), generator=generator) / 2
    goal = torch.randn(WINDOWS, 33, 2, generator=generator)
    return {
        "obs": frames[:, :-1], "next_obs": frames[:, 1:], "mask": mask[:, :-1], "next_mask": mask[:, 1:],
        "goal_mask": mask[:, 1:], "goal": goal[:, :-1], "next_goal": goal[:, 1:],
        "action": torch.randn(WINDOWS, 32, 3, generator=generator),
    }  # fmt: skip


def training_step(name: str, plain: bool) -> Callable[[], float]:
    """Return work that does one step; `plain` as the layers are written."""
    import torch

    from navrep_data.models import VAE
    from navrep_data.train import default_recipe, passes
    from navrep_data.train.optim import clip, make_optimizer
    from navrep_data.train.tasks import make_task
    from navrep_data.train.world_models import make_model

    kind, lidar = name.split("_")
    recipe = default_recipe(kind, lidar)
    if plain:
        recipe = recipe.replace(precision="float32", reconstruct_share=1.0, predict_share=1.0)
    model = make_model(recipe)
    task, optimizer, batch = (
        make_task(model, recipe, torch.device("cpu")),
        make_optimizer(model, recipe),
        made_up_batch(lidar),
    )
    done = 0

    def plain_logits(vae: VAE, z: torch.Tensor, _: torch.dtype) -> torch.Tensor:
        return vae.decoder[:-1](vae.fc3(z)).reshape(-1, *batch["obs"].shape[2:])

    def plain_codes(vae: VAE, obs: torch.Tensor, _: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
        return vae.distribution(obs)

    def work() -> float:
        nonlocal done
        ours = passes.decode_logits, passes.distribution
        if plain:
            passes.decode_logits, passes.distribution = plain_logits, plain_codes
        try:
            optimizer.zero_grad()
            for terms in task.parts(batch, done):
                terms.total.backward()
            clip(model, recipe)
            optimizer.step()
        finally:
            passes.decode_logits, passes.distribution = ours
        done += 1
        return float(batch["mask"].sum())

    return work


def encoders(lidar: str) -> list[Callable[[], float]]:
    """Return work that encodes 256 scans of training worlds: in 8 bits, and in bfloat16."""
    import torch

    from navrep_data.models import VAE, FrozenEncoder, QuantizedEncoder, VAEConfig, observation_from_scan
    from navrep_data.sim import Simulator, make_config

    torch.manual_seed(0)
    vae = VAE(VAEConfig(lidar, 64)).eval()
    simulator = Simulator(make_config("navrep-train"), 256, seed=0)
    simulator.reset()
    obs = observation_from_scan(simulator.observe()[0], lidar)

    def work(encode: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[], float]:
        return lambda: float(len(encode(obs)))

    return [work(QuantizedEncoder(vae, obs)), work(FrozenEncoder.of(vae, "bfloat16"))]


def extractors(lidar: str) -> list[Callable[[], float]]:
    """Return work that passes 1,024 rows through an end-to-end network's convolutions and back, ours and as written."""
    import gymnasium
    import numpy as np
    import torch

    from navrep_data.train.ppo_policy import FastExtractor
    from navrep_data.zoo.sb3 import EndToEndExtractor

    torch.manual_seed(0)
    space = gymnasium.spaces.Box(-np.inf, np.inf, ({"rings": 4101, "1d": 1085}[lidar],), np.float32)
    rows = torch.rand(1024, *space.shape)

    def work(extractor: torch.nn.Module) -> Callable[[], float]:
        def once() -> float:
            extractor.zero_grad()
            extractor(rows).square().sum().backward()
            return float(len(rows))

        return once

    return [work(FastExtractor(space, lidar, "bfloat16")), work(EndToEndExtractor(space, lidar))]


def controller(name: str, seconds: float) -> dict[str, Any]:
    """Return steps per second of PPO iterations, and where they go."""
    import torch

    from navrep_data.models import TransformerConfig, TransformerWorldModel
    from navrep_data.train import controllers, default_controller_recipe
    from navrep_data.train.learner import make_encoder, make_worlds

    lidar, features = name.split("_")
    torch.manual_seed(0)
    model = TransformerWorldModel(TransformerConfig(lidar, action_alignment="taken", residual=True))
    recipe = default_controller_recipe(features, lidar)
    network = controllers.make_network(recipe, model)
    worlds = make_worlds(recipe, network, model, make_encoder(recipe, model), 0)
    ppo = controllers.make_ppo(recipe, worlds, network, "cpu")
    size = recipe.worlds * recipe.rollout
    ppo.learn(size)
    for group in worlds.groups:
        group.seconds = dict.fromkeys(group.seconds, 0.0)
    rates, began = [], time.perf_counter()
    while time.perf_counter() - began < seconds or len(rates) < 2:
        start = time.perf_counter()
        ppo.learn(size, reset_num_timesteps=False)
        rates.append(size / (time.perf_counter() - start))
    spent = time.perf_counter() - began
    # of one group's thread; the others do the same beside it
    shares = {part: value / spent for part, value in worlds.groups[0].seconds.items()}
    found = spread(rates)
    return {"value": found["median"], "low": found["low"], "high": found["high"], "shares": shares}


def measure(name: str, repeats: int, seconds: float) -> dict[str, Any]:
    """Return one row of the table."""
    if name in CONTROLLERS:
        row = controller(name, repeats * seconds)
    else:
        if name in ENCODERS:
            both = encoders(name.split("_")[1])
        elif name in END_TO_END:
            both = extractors(name.split("_")[1])
        else:
            both = [training_step(name, False), training_step(name, True)]
        ours, other = in_turns(both, repeats, seconds)
        mine = spread(ours.wall)
        row = {
            "value": mine["median"], "low": mine["low"], "high": mine["high"],
            "as_written": spread(other.wall)["median"], "ratio": ratio(ours.wall, other.wall),
        }  # fmt: skip
    return {"name": name, "must": MUST.get(name), "aim": AIMS.get(name), **row}


HEADER = ("training", "per second", "spread", "must", "aim", "verdict", "compared with", "ratio")
INTRODUCTION = """## Training

{machine}

World models: frames per second of a training step of 32 windows, against the layers as they are written. Encoders in
8 bits: frames per second, against bfloat16. e2e: rows per second through an end-to-end network's convolutions and back,
against the layers as they are written. Controllers: steps per second of whole PPO iterations in 256 worlds
(rollout, encoding, update). {threads} threads, wall time, medians over turns.
"""


def verdict(row: dict[str, Any]) -> str:
    """Return whether a row reaches what it must."""
    if row["must"] is None:
        return "-"
    return "pass" if row["value"] >= row["must"] else "FAIL"


def show(row: dict[str, Any]) -> list[str]:
    """Return a measured row as the cells of the table."""
    other = [number(row["as_written"]), f"{row['ratio']:.2f}"] if "ratio" in row else ["-", "-"]
    shares = "".join(f", {part} {100 * share:.0f} %" for part, share in row.get("shares", {}).items())
    return [
        row["name"] + shares, number(row["value"]), f"{number(row['low'])} to {number(row['high'])}",
        number(row["must"]), number(row["aim"]), verdict(row), *other,
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", default=[*WORLD_MODELS, *ENCODERS, *END_TO_END, *CONTROLLERS], metavar="NAME"
    )
    parser.add_argument("--repeats", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--write", action="store_true", help="update benchmarks/RESULTS.md")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    import torch

    if args.threads:
        torch.set_num_threads(args.threads)
    where, rows = machine(), []
    for name in args.only:
        print(f"measuring {name} ...", file=sys.stderr, flush=True)
        rows.append(measure(name, args.repeats, args.seconds))
    if args.json:
        print(json.dumps({"machine": where, "threads": torch.get_num_threads(), "rows": rows}))
    else:
        text = INTRODUCTION.format(machine=describe(where), threads=torch.get_num_threads())
        text += "\n" + table(HEADER, map(show, rows))
        print(text)
        if args.write:
            write_section("training.py", text)
    return int(any(verdict(row) == "FAIL" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
